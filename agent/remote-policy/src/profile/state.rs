//! The robot's state in an observation.

use anyhow::{Result, bail};
use decision::{quaternion, rotation_vector};

use super::{StateInput, StateValue};

impl StateInput {
    /// The numbers for the server.
    pub fn numbers(&self, state: &[f32]) -> Result<Vec<f32>> {
        if self.values == [StateValue::All] {
            return Ok(state.to_vec());
        }
        let &[x, y, z, roll, pitch, yaw, _, open] = state else {
            bail!(
                "state: expected the 8 numbers of a Bridge task (x, y, z, roll, pitch, yaw, 0, gripper), got {}; \
                 a profile with state.values = [\"all\"] passes on any state",
                state.len()
            );
        };
        let angles = [roll, pitch, yaw].map(f64::from);
        let vector = rotation_vector(angles[0], angles[1], angles[2]);
        let turned = quaternion(angles[0], angles[1], angles[2]);
        let finger = self.finger_open_metres as f32 * open;
        let number = |value: &StateValue| match value {
            StateValue::X => x,
            StateValue::Y => y,
            StateValue::Z => z,
            StateValue::Roll => roll,
            StateValue::Pitch => pitch,
            StateValue::Yaw => yaw,
            StateValue::RotationX => vector[0] as f32,
            StateValue::RotationY => vector[1] as f32,
            StateValue::RotationZ => vector[2] as f32,
            StateValue::QuaternionW => turned[0] as f32,
            StateValue::QuaternionX => turned[1] as f32,
            StateValue::QuaternionY => turned[2] as f32,
            StateValue::QuaternionZ => turned[3] as f32,
            StateValue::GripperOpen => open,
            StateValue::GripperClosed => 1.0 - open,
            StateValue::Finger => finger,
            StateValue::FingerNegative => -finger,
            StateValue::Zero | StateValue::All => 0.0,
        };
        Ok(self.values.iter().map(number).collect())
    }
}
