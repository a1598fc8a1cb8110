//! What is remembered of an episode from one decision to the next.

use std::sync::Arc;

use protocol::Dimension;
use sha2::{Digest, Sha256};

use crate::{Action, ActionSpace, ObjectTracker, Scorer, Setting};

/// The memory of one episode, and how it is decided.
#[derive(Clone)]
pub struct EpisodeContext {
    /// How candidates are drawn and chosen.
    pub setting: Setting,
    /// What the robot is told to do.
    pub instruction: String,
    /// The same from the first step to the last, whatever is published meanwhile.
    pub scorer: Option<Arc<dyn Scorer>>,
    /// The policy's seed, the same for every strategy.
    pub sampling_seed: u64,
    /// Control steps so far.
    pub step: u32,
    /// Where the reasoning so far sees the objects.
    pub tracker: ObjectTracker,
    /// Holds the robot still: no motion, and the gripper as it was told last.
    hold_still: Action,
}

impl EpisodeContext {
    /// Of an episode that begins now; `action` are the numbers of the task's actions.
    pub fn new(
        setting: Setting,
        sampling_seed: u64,
        instruction: impl Into<String>,
        scorer: Option<Arc<dyn Scorer>>,
        action: &[Dimension],
    ) -> EpisodeContext {
        EpisodeContext {
            setting,
            instruction: instruction.into(),
            scorer,
            sampling_seed,
            step: 0,
            tracker: ObjectTracker::default(),
            hold_still: ActionSpace::hold_still(action),
        }
    }

    /// The policy's seed at this control step.
    pub fn seed(&self) -> u64 {
        step_seed(self.sampling_seed, self.step)
    }

    /// What to do where no candidate is well formed.
    pub fn hold_still(&self) -> &[f32] {
        &self.hold_still
    }

    /// Takes note of actions that are executed.
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

/// The policy's seed at one control step: every step draws from its own stream.
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
    fn every_step_of_every_episode_has_a_seed_of_its_own() {
        assert_ne!(step_seed(1, 0), step_seed(1, 1));
        assert_ne!(step_seed(1, 0), step_seed(2, 0));
        // Computed independently: the first eight bytes, little endian, of
        // `sha256(bytes.fromhex("0100000000000000" "00000000"))`.
        assert_eq!(step_seed(1, 0), SEED_OF_ONE);
    }

    const SEED_OF_ONE: u64 = 9_280_452_922_100_910_282;
}
