//! Threads side by side, each with sessions of its own, instead of all threads on each product.
//!
//! A step of the decode loop is dozens of small products. Divided among threads, each of them ends with the threads
//! waiting for each other; divided by session, they wait once per decision. The bits are the same: a row's result does
//! not depend on the rows beside it.

use std::thread;

use anyhow::{Context as _, Result, anyhow};
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::backend::Backend;
use super::generation::{Completion, Continuation, Limits, complete};
use super::network::Network;

/// Candidates per lane below which the weights, read once for all rows of a lane, would be read too often.
const LANE_CANDIDATES_MIN: usize = 16;

/// One pool of a single thread per processor.
pub struct Lanes {
    pools: Vec<ThreadPool>,
}

impl Lanes {
    /// Lanes for kernels on the processor; none where a device computes.
    pub fn new(backend: Backend) -> Result<Lanes> {
        let count = match backend {
            Backend::Kernels => rayon::current_num_threads(),
            Backend::Tensors => 0,
        };
        let one = |_| ThreadPoolBuilder::new().num_threads(1).build();
        let pools = (0..count).map(one).collect::<Result<_, _>>();
        Ok(Lanes { pools: pools.context("cannot start the policy's threads")? })
    }

    /// All completions, session by session and candidate by candidate.
    pub fn complete(
        &self,
        network: &Network,
        sessions: &[Continuation<'_>],
        limits: &Limits<'_>,
    ) -> Result<Vec<Completion>> {
        let candidates: usize = sessions.iter().map(|session| session.candidates).sum();
        let lanes = (candidates / LANE_CANDIDATES_MIN)
            .min(sessions.len())
            .min(self.pools.len())
            .min(rayon::current_num_threads());
        if lanes < 2 {
            // From outside of its pool, each of a step's dozens of products would wake a thread and wait for it.
            return rayon::scope(|_| complete(network, sessions, limits));
        }
        let run = |lane: usize| -> Result<Vec<Completion>> {
            let start = lane * sessions.len() / lanes;
            let own = &sessions[start..(lane + 1) * sessions.len() / lanes];
            let mut completions = self.pools[lane].install(|| complete(network, own, limits))?;
            completions.iter_mut().for_each(|completion| completion.session += start);
            Ok(completions)
        };
        let run = &run;
        let parts = thread::scope(|scope| {
            let threads: Vec<_> = (0..lanes).map(|lane| scope.spawn(move || run(lane))).collect();
            let join = |thread: thread::ScopedJoinHandle<'_, _>| {
                thread.join().unwrap_or_else(|_| Err(anyhow!("a lane of the policy panicked")))
            };
            threads.into_iter().map(join).collect::<Result<Vec<_>>>()
        })?;
        Ok(parts.into_iter().flatten().collect())
    }
}
