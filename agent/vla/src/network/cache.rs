//! The caches of a network: keys and values of the prompts, and of the tokens after them.

use anyhow::Result;
use std::ops::Range;

use crate::kernels::backend::Backend;
use crate::network::attention::{Group, Prefix, Tail};
use crate::network::rotary::HeadShape;

/// The keys and values of each session's image and prompt; immutable and shared by its candidates.
pub struct PrefixCache {
    pub(crate) layers: Vec<Prefix>,
    lengths: Vec<usize>,
}

/// The keys and values that each row has added; all rows have the same length.
pub struct TailCache {
    pub(crate) layers: Vec<Tail>,
    sessions: Vec<usize>,
    length: usize,
}

impl PrefixCache {
    pub(crate) fn new(layers: Vec<Prefix>, sessions: &[Range<usize>]) -> PrefixCache {
        PrefixCache { layers, lengths: sessions.iter().map(Range::len).collect() }
    }

    /// Concatenates the sessions of several caches.
    pub(crate) fn join(parts: Vec<PrefixCache>) -> PrefixCache {
        let lengths = parts.iter().flat_map(|part| part.lengths.iter().copied()).collect();
        let mut layers: Vec<std::vec::IntoIter<Prefix>> =
            parts.into_iter().map(|part| part.layers.into_iter()).collect();
        let next = || Prefix::join(layers.iter_mut().filter_map(Iterator::next).collect());
        PrefixCache { layers: std::iter::from_fn(next).collect(), lengths }
    }
}

impl TailCache {
    /// Empty tails; `sessions` is the session of each row, in ascending order.
    pub fn new(
        sessions: Vec<usize>,
        capacity: usize,
        layers: usize,
        shape: HeadShape,
        backend: Backend,
    ) -> TailCache {
        assert!(sessions.is_sorted(), "rows of one session are adjacent");
        let layer = || Tail::new(sessions.len(), capacity, shape, backend);
        TailCache { layers: (0..layers).map(|_| layer()).collect(), sessions, length: 0 }
    }

    /// Row i becomes a copy of row `parents[i]`; rows that are not a parent are dropped.
    pub fn fork(&mut self, parents: &[usize]) -> Result<()> {
        self.sessions = parents.iter().map(|&parent| self.sessions[parent]).collect();
        assert!(self.sessions.is_sorted(), "rows of one session are adjacent");
        for layer in &mut self.layers {
            layer.fork(parents)?;
        }
        Ok(())
    }

    /// The next position of each row in its sequence.
    pub(crate) fn positions(&self, prefix: &PrefixCache) -> Vec<usize> {
        self.sessions.iter().map(|&session| prefix.lengths[session] + self.length).collect()
    }

    /// The rows of each session.
    pub(crate) fn groups(&self) -> Vec<Group> {
        let mut start = 0;
        let chunks = self.sessions.chunk_by(|a, b| a == b);
        let group = |chunk: &[usize]| {
            let rows = start..start + chunk.len();
            start = rows.end;
            Group { session: chunk[0], rows }
        };
        chunks.map(group).collect()
    }

    pub(crate) fn advance(&mut self) {
        self.length += 1;
    }
}
