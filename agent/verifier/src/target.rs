//! The target model: where the gripper should be, given the objects' bounding boxes.
//!
//! The map from an object's bounding box to the gripper's position is learned from the positions of
//! grasps and of the releases of successful episodes. A candidate that brings the gripper nearer to
//! the target agrees with the reasoning of the whole episode so far.

use std::collections::BTreeMap;

use anyhow::ensure;
use decision::{BoundingBox, Stage, TrackedObjects};

/// Terms of the polynomial: 1, the four sides, their squares and products.
pub const TERMS: usize = 15;

/// Sides are measured from the image centre in units of this many pixels.
const UNIT_PIXELS: f64 = 64.0;

/// Maximum coefficient in metres: no gripper is a kilometre away from its base.
const COEFFICIENT_MAX: f32 = 1e3;

/// The map from an object's box to a gripper position: x and y in the robot's base frame, in
/// metres.
#[derive(Clone, Debug, PartialEq)]
pub struct TargetMap {
    coefficients: [[f32; 2]; TERMS],
}

impl TargetMap {
    /// Checks that the coefficients are finite and not too large.
    pub fn new(coefficients: [[f32; 2]; TERMS]) -> anyhow::Result<TargetMap> {
        for number in coefficients.as_flattened() {
            ensure!(
                number.abs() <= COEFFICIENT_MAX,
                "target map: expected coefficients of at most {COEFFICIENT_MAX} m, got {number}"
            );
        }
        Ok(TargetMap { coefficients })
    }

    /// The coefficients of x and y for each term.
    pub fn coefficients(&self) -> &[[f32; 2]; TERMS] {
        &self.coefficients
    }

    /// The gripper position for an object with these bounds.
    pub fn position(&self, bounds: &BoundingBox) -> [f32; 2] {
        let terms = terms(bounds);
        [0, 1].map(|axis| {
            let products = terms.iter().zip(&self.coefficients);
            products.map(|(term, of)| term * f64::from(of[axis])).sum::<f64>() as f32
        })
    }
}

/// The polynomial's terms for a box.
pub fn terms(bounds: &BoundingBox) -> [f64; TERMS] {
    let sides = bounds.map(|side| (f64::from(side) - 128.0) / UNIT_PIXELS);
    let mut terms = [1.0; TERMS];
    terms[1..5].copy_from_slice(&sides);
    let products = (0..4).flat_map(|left| (left..4).map(move |right| (left, right)));
    for (term, (left, right)) in terms[5..].iter_mut().zip(products) {
        *term = sides[left] * sides[right];
    }
    terms
}

/// The maps of all instructions with enough training data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TargetModel {
    maps: BTreeMap<(String, Stage), TargetMap>,
}

/// The target relative to the gripper's position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictedTarget {
    /// The stage that determines the target object.
    pub stage: Stage,
    /// Offset from the gripper: x and y in the base frame, in metres.
    pub offset: [f32; 2],
}

impl TargetModel {
    /// Inserts or replaces the map of a stage.
    pub fn insert(&mut self, instruction: &str, stage: Stage, map: TargetMap) {
        self.maps.insert((instruction.to_owned(), stage), map);
    }

    /// All maps with their instruction and stage.
    pub fn maps(&self) -> impl Iterator<Item = (&str, Stage, &TargetMap)> {
        self.maps.iter().map(|((instruction, stage), map)| (instruction.as_str(), *stage, map))
    }

    /// The target for a gripper at x, y. `None` if the gripper's position is unknown, the stage has
    /// no target object, or the instruction has no map.
    pub fn predict(
        &self,
        instruction: &str,
        tracked: &TrackedObjects,
        gripper: Option<[f32; 2]>,
    ) -> Option<PredictedTarget> {
        let (stage, gripper) = (tracked.stage?, gripper?);
        let bounds = tracked.bounds[stage as usize]?;
        let [x, y] = self.maps.get(&(instruction.to_owned(), stage))?.position(&bounds);
        Some(PredictedTarget { stage, offset: [x - gripper[0], y - gripper[1]] })
    }
}

impl PredictedTarget {
    /// Distance from the target after a motion by x and y, in metres.
    pub fn distance(&self, motion: [f32; 2]) -> f32 {
        (self.offset[0] - motion[0]).hypot(self.offset[1] - motion[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_the_offset_from_the_gripper_to_the_mapped_position() {
        let mut coefficients = [[0.0; 2]; TERMS];
        // x = 0.3 + 0.1 left, y = 0.2 top x bottom, with sides in units of 64 pixels from the
        // centre.
        coefficients[0][0] = 0.3;
        coefficients[1][0] = 0.1;
        coefficients[11][1] = 0.2;
        let map = TargetMap::new(coefficients).expect("finite");
        let bounds = [192.0, 64.0, 200.0, 256.0];
        let mut model = TargetModel::default();
        model.insert("stack", Stage::Place, map);
        let tracked = TrackedObjects { stage: Some(Stage::Place), bounds: [None, Some(bounds)] };
        let target = model.predict("stack", &tracked, Some([0.3, -0.4])).expect("a target");
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(near(target.offset[0], 0.1) && near(target.offset[1], 0.0), "{target:?}");
        assert!(near(target.distance([0.1, 0.02]), 0.02));
        assert_eq!(model.predict("other", &tracked, Some([0.0; 2])), None);
        assert_eq!(model.predict("stack", &tracked, None), None);
        let grasping = TrackedObjects { stage: Some(Stage::Grasp), ..tracked };
        assert_eq!(model.predict("stack", &grasping, Some([0.0; 2])), None);
    }

    #[test]
    fn maps_out_of_reach_are_refused() {
        for (coefficient, shown) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (-3e38, "-3")] {
            let mut coefficients = [[0.0; 2]; TERMS];
            coefficients[3][0] = coefficient;
            let error = TargetMap::new(coefficients).expect_err("refused").to_string();
            let expected = format!("expected coefficients of at most 1000 m, got {shown}");
            assert!(error.contains(&expected), "{error}");
        }
    }
}
