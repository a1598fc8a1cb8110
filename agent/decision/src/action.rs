//! Actions of one or several control steps.

use anyhow::{Result, ensure};
use protocol::Dimension;
use serde::{Deserialize, Serialize};

/// The action of one control step, with the dimensions in the task's description. For a Bridge
/// task: translation in metres, rotation vector in radians, gripper +1 open or -1 closed, in the
/// base frame.
pub type Action = Vec<f32>;

/// Name of the dimension that opens and closes a gripper.
const GRIPPER: &str = "gripper";

/// The actions of one decision, executed in consecutive control steps. Never empty; all have the
/// same length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<Action>", into = "Vec<Action>")]
pub struct ActionChunk {
    actions: Vec<Action>,
}

impl ActionChunk {
    /// Refuses an empty chunk, actions of different lengths and numbers that are not finite.
    pub fn new(actions: Vec<Action>) -> Result<ActionChunk> {
        let length = actions.first().map_or(0, Vec::len);
        ensure!(length > 0, "action chunk: expected at least one action of at least one number");
        if let Some(other) = actions.iter().find(|action| action.len() != length) {
            anyhow::bail!(
                "action chunk: expected {length} numbers in every action, got {}",
                other.len()
            );
        }
        ensure!(
            actions.iter().flatten().all(|number| number.is_finite()),
            "action chunk: expected finite numbers, got NaN or infinity"
        );
        Ok(ActionChunk { actions })
    }

    /// The chunk of a policy that decides in every control step.
    pub fn single(action: Action) -> Result<ActionChunk> {
        ActionChunk::new(vec![action])
    }

    /// The action of the first control step.
    pub fn first(&self) -> &[f32] {
        &self.actions[0]
    }

    /// All actions in the order of their execution.
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    /// All actions in the order of their execution.
    pub fn into_actions(self) -> Vec<Action> {
        self.actions
    }

    /// Number of dimensions of each action.
    pub fn action_length(&self) -> usize {
        self.actions[0].len()
    }
}

impl TryFrom<Vec<Action>> for ActionChunk {
    type Error = anyhow::Error;

    fn try_from(actions: Vec<Action>) -> Result<ActionChunk> {
        ActionChunk::new(actions)
    }
}

impl From<ActionChunk> for Vec<Action> {
    fn from(chunk: ActionChunk) -> Vec<Action> {
        chunk.actions
    }
}

/// The dimensions of a policy's actions, and how to compare two actions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ActionSpace {
    /// The unit of each dimension: q99 - q01 of the checkpoint's statistics, and 2 for the gripper.
    /// A dimension with unit 0 has no range and is ignored in comparisons.
    pub scale: Vec<f32>,
    /// Index of the gripper dimension, of which only the sign is compared.
    pub gripper: Option<usize>,
}

impl ActionSpace {
    /// Number of dimensions of an action.
    pub fn length(&self) -> usize {
        self.scale.len()
    }

    /// The dimensions as a task would describe them, without bounds.
    pub fn dimensions(&self) -> Vec<Dimension> {
        let dimension = |index| Dimension {
            name: if self.gripper == Some(index) { GRIPPER } else { "motion" }.to_owned(),
            low: None,
            high: None,
            discrete: false,
        };
        (0..self.length()).map(dimension).collect()
    }

    /// The action that keeps a robot still at the start of an episode: no motion, gripper open.
    pub fn hold_still(dimensions: &[Dimension]) -> Action {
        dimensions.iter().map(|one| if one.name == GRIPPER { 1.0 } else { 0.0 }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chunk_has_actions_of_one_length_and_finite_numbers() {
        let chunk = ActionChunk::new(vec![vec![0.5, 1.0], vec![0.25, -1.0]]).expect("a chunk");
        assert_eq!((chunk.first(), chunk.action_length()), ([0.5, 1.0].as_slice(), 2));
        for (actions, expected) in [
            (vec![], "at least one action"),
            (vec![vec![]], "at least one action"),
            (vec![vec![0.5], vec![0.5, 1.0]], "expected 1 numbers in every action, got 2"),
            (vec![vec![f32::NAN]], "expected finite numbers"),
        ] {
            let error = ActionChunk::new(actions).expect_err(expected).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn holding_still_is_no_motion_with_an_open_gripper() {
        let dimension = |name: &str| Dimension {
            name: name.to_owned(),
            low: None,
            high: None,
            discrete: false,
        };
        let dimensions = ["x", "gripper", "yaw"].map(dimension);
        assert_eq!(ActionSpace::hold_still(&dimensions), [0.0, 1.0, 0.0]);
    }
}
