//! The actions of a server in the agent's units: metres, rotation vector in radians, gripper +1
//! open or -1 closed.

use anyhow::{Result, ensure};
use decision::{ActionChunk, ActionSpace, rotation_vector};

use super::{Actions, Gripper, Rotation};

impl Actions {
    /// The actions to execute of those that a server sent.
    pub fn chunk(&self, received: &[Vec<f32>]) -> Result<ActionChunk> {
        let actions = received.iter().take(self.execute).map(|action| self.action(action));
        ActionChunk::new(actions.collect::<Result<_>>()?)
    }

    /// How actions are compared.
    pub fn space(&self) -> ActionSpace {
        let has_gripper = self.gripper != Gripper::None;
        ActionSpace { scale: self.scale.clone(), gripper: has_gripper.then(|| self.dimensions - 1) }
    }

    fn action(&self, received: &[f32]) -> Result<Vec<f32>> {
        let (expected, got) = (self.dimensions, received.len());
        ensure!(got >= expected, "actions: expected {expected} dimensions, got {got}");
        let mut action = received[..expected].to_vec();
        if let Some(range) = &self.normalised {
            for (number, (low, high)) in action.iter_mut().zip(range.low.iter().zip(&range.high)) {
                let [value, low, high] = [*number, *low, *high].map(f64::from);
                *number = (low + (value + 1.0) / 2.0 * (high - low)) as f32;
            }
        }
        if self.rotation == Rotation::Euler {
            let angles = [action[3], action[4], action[5]].map(f64::from);
            let vector = rotation_vector(angles[0], angles[1], angles[2]);
            action[3..6].copy_from_slice(&vector.map(|number| number as f32));
        }
        if let Some(last) = action.last_mut() {
            match self.gripper {
                Gripper::None => {}
                Gripper::Nearest { open, closed } => {
                    let is_open = (*last - open).abs() < (*last - closed).abs();
                    *last = if is_open { 1.0 } else { -1.0 };
                }
                Gripper::Linear { open, closed } => {
                    *last = ((*last - closed) / (open - closed) * 2.0 - 1.0).clamp(-1.0, 1.0);
                }
            }
        }
        Ok(action)
    }
}
