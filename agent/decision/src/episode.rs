//! The identity of a running episode, for policies that keep a state between its decisions.

use std::sync::{Arc, Weak};

/// A running episode. Clones are the same episode; it ends when the last one is dropped.
#[derive(Debug, Clone)]
pub struct EpisodeToken(Arc<EpisodeName>);

/// What the episode is about, for servers that log or select by it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EpisodeName {
    /// The name of the task.
    pub task: String,
    /// The number of the episode among those of the task.
    pub episode: u32,
}

/// Tells when an episode has ended.
#[derive(Debug, Clone)]
pub struct EpisodeWatch(Weak<EpisodeName>);

impl EpisodeToken {
    /// A new episode, different from all others.
    pub fn new(name: EpisodeName) -> EpisodeToken {
        EpisodeToken(Arc::new(name))
    }

    /// The episode's name, which other episodes may have, too.
    pub fn name(&self) -> &EpisodeName {
        &self.0
    }

    /// A number that no other episode has as long as this one is watched.
    pub fn key(&self) -> usize {
        Arc::as_ptr(&self.0) as usize
    }

    /// A watch that does not keep the episode alive.
    pub fn watch(&self) -> EpisodeWatch {
        EpisodeWatch(Arc::downgrade(&self.0))
    }
}

impl EpisodeWatch {
    /// Whether all tokens of the episode were dropped.
    pub fn is_over(&self) -> bool {
        self.0.strong_count() == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_ends_with_its_last_token() {
        let token = EpisodeToken::new(EpisodeName::default());
        let (watch, clone) = (token.watch(), token.clone());
        let other = EpisodeToken::new(token.name().clone());
        assert_eq!(token.key(), clone.key());
        assert_ne!(token.key(), other.key(), "a name is no identity");
        drop(token);
        assert!(!watch.is_over());
        drop(clone);
        assert!(watch.is_over());
    }
}
