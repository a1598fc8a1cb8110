//! Action tokens: OpenVLA's bins and their conversion to metres, rotation vector and gripper
//! command.

use decision::{roll_pitch_yaw, rotation_vector};

use crate::checkpoint::config::{ACTION_LENGTH, ActionScale};

/// The token ids of actions and their meaning.
pub struct ActionBins {
    vocabulary: usize,
    bins: usize,
    scale: ActionScale,
}

impl ActionBins {
    /// Bin digit d (1 to `bins`) has id `vocabulary` - d.
    pub fn new(vocabulary: usize, bins: usize, scale: ActionScale) -> ActionBins {
        ActionBins { vocabulary, bins, scale }
    }

    /// Whether an id is an action token.
    pub fn contains(&self, id: u32) -> bool {
        (self.vocabulary - self.bins..self.vocabulary).contains(&(id as usize))
    }

    /// The bin centre of an id, in -1..1. There is one centre fewer than there are ids: the last
    /// two ids share one.
    pub fn centre(&self, id: u32) -> f64 {
        assert!(self.contains(id), "action id: expected one of the last {}, got {id}", self.bins);
        let digit = self.vocabulary - id as usize;
        let centres = self.bins - 1;
        let index = (digit - 1).min(centres - 1);
        -1.0 + (2 * index + 1) as f64 / centres as f64
    }

    /// The action: metres, rotation vector in radians, gripper +1 open or -1 closed.
    pub fn decode(&self, ids: [u32; ACTION_LENGTH]) -> [f32; ACTION_LENGTH] {
        let physical: [f64; ACTION_LENGTH] = std::array::from_fn(|index| {
            let centre = self.centre(ids[index]);
            let (low, high) = (self.scale.q01[index], self.scale.q99[index]);
            if self.scale.mask[index] { 0.5 * (centre + 1.0) * (high - low) + low } else { centre }
        });
        let [x, y, z, roll, pitch, yaw, gripper] = physical;
        let rotation = rotation_vector(roll, pitch, yaw);
        let gripper = if gripper > 0.5 { 1.0 } else { -1.0 };
        [x, y, z, rotation[0], rotation[1], rotation[2], gripper].map(|number| number as f32)
    }

    /// The ids of the bins of an action, by OpenVLA's `digitize`: the inverse of [`Self::decode`]
    /// up to the width of a bin. Numbers beyond the range are in the outermost bins. Of the two ids
    /// that share the last centre this is the outer one, which stands for all numbers beyond it.
    pub fn encode(&self, action: &[f32; ACTION_LENGTH]) -> [u32; ACTION_LENGTH] {
        let [x, y, z, a, b, c, gripper] = action.map(f64::from);
        let [roll, pitch, yaw] = roll_pitch_yaw([a, b, c]);
        let physical = [x, y, z, roll, pitch, yaw, if gripper > 0.0 { 1.0 } else { 0.0 }];
        std::array::from_fn(|index| {
            let (low, high) = (self.scale.q01[index], self.scale.q99[index]);
            let value = physical[index];
            let scaled = match self.scale.mask[index] {
                true if high > low => 2.0 * (value - low) / (high - low) - 1.0,
                true => 0.0,
                false => value,
            };
            // np.digitize: the number of edges of np.linspace(-1, 1, bins) that are not above it.
            let steps = (self.bins - 1) as f64;
            let digit = ((scaled.clamp(-1.0, 1.0) + 1.0) / 2.0 * steps).floor() as usize + 1;
            let outer = if digit + 1 == self.bins { self.bins } else { digit };
            (self.vocabulary - outer) as u32
        })
    }

    /// The unit of each dimension of an action: its range, and 2 for the gripper.
    pub fn units(&self) -> [f32; ACTION_LENGTH] {
        let mut units = [2.0; ACTION_LENGTH];
        for (index, unit) in units.iter_mut().enumerate().take(ACTION_LENGTH - 1) {
            if self.scale.mask[index] {
                *unit = (self.scale.q99[index] - self.scale.q01[index]) as f32;
            }
        }
        units
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn openvla() -> ActionBins {
        let scale = ActionScale {
            q01: [-0.02, -0.04, -0.03, -0.1, -0.1, -0.2, 0.0],
            q99: [0.03, 0.04, 0.04, 0.1, 0.1, 0.2, 1.0],
            mask: [true, true, true, true, true, true, false],
        };
        ActionBins::new(32000, 256, scale)
    }

    #[test]
    fn there_are_255_centres_and_the_last_two_ids_share_one() {
        let bins = openvla();
        assert_eq!(bins.centre(31999), -1.0 + 1.0 / 255.0);
        assert_eq!(bins.centre(31744), bins.centre(31745));
        assert_eq!(bins.centre(31745), 1.0 - 1.0 / 255.0);
        let mut centres: Vec<f64> = (31744..32000).map(|id| bins.centre(id)).collect();
        centres.dedup();
        assert_eq!(centres.len(), 255);
        assert!(centres.windows(2).all(|pair| (pair[0] - pair[1] - 2.0 / 255.0).abs() < 1e-12));
        assert!(!bins.contains(31743) && !bins.contains(32000));
    }

    #[test]
    fn extreme_ids_decode_to_the_ends_of_the_range() {
        let action = openvla().decode([31999, 31745, 31872, 31872, 31872, 31872, 31745]);
        // np.linspace(-1, 1, 256): centre 0 is -254/255, centre 127 is 0
        assert!((f64::from(action[0]) - (-0.02 + 0.05 * 0.5 / 255.0)).abs() < 1e-8);
        assert!((f64::from(action[1]) - (0.04 - 0.08 * 0.5 / 255.0)).abs() < 1e-8);
        assert!((f64::from(action[2]) - 0.005).abs() < 1e-8);
        assert_eq!(action[3..6], [0.0; 3]);
        assert_eq!(action[6], 1.0);
        assert_eq!(openvla().decode([31872; 7])[6], -1.0);
    }

    #[test]
    fn actions_are_encoded_as_the_bins_that_they_were_decoded_from() {
        let bins = openvla();
        for digit in [1_usize, 2, 77, 128, 200, 254] {
            // The gripper has two commands: 1 is in the last bin and 0 in the middle one.
            for gripper in [1_usize, 255] {
                let mut ids = [(32000 - digit) as u32; 7];
                ids[6] = (32000 - gripper) as u32;
                let expected = if gripper == 255 { 32000 - 256 } else { 32000 - 128 };
                let encoded = bins.encode(&bins.decode(ids));
                assert_eq!((&encoded[..6], encoded[6]), (&ids[..6], expected), "digit {digit}");
            }
        }
        let far = bins.encode(&[9.0, -9.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!((far[0], far[1]), (32000 - 256, 32000 - 1));
    }

    #[test]
    fn rotation_vectors_follow_fixed_axes() {
        fn check(angles: [f64; 3], expected: [f64; 3]) {
            let got = rotation_vector(angles[0], angles[1], angles[2]);
            for (got, expected) in got.iter().zip(expected) {
                assert!((got - expected).abs() < 1e-9, "{angles:?}: {got} is not {expected}");
            }
        }
        check([0.0; 3], [0.0; 3]);
        check([0.3, 0.0, 0.0], [0.3, 0.0, 0.0]);
        check([0.0, -0.2, 0.0], [0.0, -0.2, 0.0]);
        check([0.0, 0.0, 3.0], [0.0, 0.0, 3.0]);
        // numpy: matrix = z(yaw) @ y(pitch) @ x(roll); angle = acos((trace - 1) / 2); the axis is
        // [m21 - m12, m02 - m20, m10 - m01] / (2 sin angle).
        let expected = [0.06892461388206564, 0.21322592695788625, 0.2887489392286753];
        check([0.1, 0.2, 0.3], expected);
        let expected = [-0.20651554091555197, 1.1297979891665737, 0.20651554091555197];
        check([3.0, 2.0, -3.0], expected);
    }
}
