//! The state of an episode that persists between decisions.

use std::sync::Arc;

use protocol::Dimension;
use sha2::{Digest, Sha256};

use crate::{Action, ActionSpace, EpisodeName, EpisodeToken, ObjectTracker, Scorer, Setting};

/// The setting and the state of one episode.
#[derive(Clone)]
pub struct EpisodeContext {
    /// How candidates are sampled and selected.
    pub setting: Setting,
    /// The language instruction for the robot.
    pub instruction: String,
    /// The scorer of the whole episode, even if a new verifier is published meanwhile.
    pub scorer: Option<Arc<dyn Scorer>>,
    /// Seed of the policy's sampling, the same for every strategy.
    pub sampling_seed: u64,
    /// The episode's identity, for policies that keep a state between its decisions.
    pub episode: EpisodeToken,
    /// Seed of the policy's sampling in the next decision, where a client of a policy server gives
    /// one; otherwise it is derived from `sampling_seed` and `step`.
    pub decision_seed: Option<u64>,
    /// Number of control steps so far.
    pub step: u32,
    /// Object positions according to the reasoning so far.
    pub tracker: ObjectTracker,
    /// The action that keeps the robot still: no motion, with the last gripper command.
    hold_still: Action,
}

impl EpisodeContext {
    /// The context at the start of an episode; `action` is the task's action space.
    pub fn new(
        setting: Setting,
        sampling_seed: u64,
        instruction: impl Into<String>,
        scorer: Option<Arc<dyn Scorer>>,
        action: &[Dimension],
    ) -> EpisodeContext {
        let instruction = instruction.into();
        let name = EpisodeName { task: instruction.clone(), episode: 0 };
        EpisodeContext {
            setting,
            instruction,
            scorer,
            sampling_seed,
            episode: EpisodeToken::new(name),
            decision_seed: None,
            step: 0,
            tracker: ObjectTracker::default(),
            hold_still: ActionSpace::hold_still(action),
        }
    }

    /// Seed of the policy's sampling at this control step.
    pub fn seed(&self) -> u64 {
        self.decision_seed.unwrap_or_else(|| step_seed(self.sampling_seed, self.step))
    }

    /// The action to execute if no candidate is well formed.
    pub fn hold_still(&self) -> &[f32] {
        &self.hold_still
    }

    /// Updates the context with executed actions.
    pub(crate) fn note(&mut self, actions: &[Action], space: &ActionSpace) {
        self.step += actions.len() as u32;
        let last = actions.last().zip(space.gripper);
        if let Some((action, gripper)) = last
            && let (Some(held), Some(number)) =
                (self.hold_still.get_mut(gripper), action.get(gripper))
        {
            *held = *number;
        }
    }
}

/// Seed of the policy's sampling at one control step: every step uses its own random stream.
pub fn step_seed(sampling_seed: u64, step: u32) -> u64 {
    let digest = Sha256::new()
        .chain_update(sampling_seed.to_le_bytes())
        .chain_update(step.to_le_bytes())
        .finalize();
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_of_every_episode_has_its_own_seed() {
        assert_ne!(step_seed(1, 0), step_seed(1, 1));
        assert_ne!(step_seed(1, 0), step_seed(2, 0));
        // Computed independently: the first eight bytes in little-endian order of
        // `sha256(bytes.fromhex("0100000000000000" "00000000"))`.
        assert_eq!(step_seed(1, 0), SEED_OF_ONE);
    }

    const SEED_OF_ONE: u64 = 9_280_452_922_100_910_282;
}
