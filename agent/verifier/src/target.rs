//! Where the gripper should go, given where the objects are.
//!
//! Which position of the gripper belongs to an object's bounding box is learned from where grasps were made and where
//! successful episodes released the object. A candidate whose action brings the gripper nearer to that position agrees
//! with all the reasoning of the episode so far.

use std::collections::BTreeMap;

use anyhow::ensure;
use decision::{BoundingBox, Stage, TrackedObjects};

/// Terms of a map's polynomial: 1, the four sides, their squares and products.
pub const TERMS: usize = 15;

/// Sides are counted from the middle of the square, in units of this many pixels.
const UNIT_PIXELS: f64 = 64.0;

/// A map with a larger coefficient is refused: no gripper is a kilometre away from its base.
const COEFFICIENT_MAX: f32 = 1e3;

/// From an object's box to a position of the gripper: x and y in the robot's base frame, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct TargetMap {
    coefficients: [[f32; 2]; TERMS],
}

impl TargetMap {
    /// Refuses coefficients that are not finite or larger than any gripper's reach.
    pub fn new(coefficients: [[f32; 2]; TERMS]) -> anyhow::Result<TargetMap> {
        for number in coefficients.as_flattened() {
            ensure!(
                number.abs() <= COEFFICIENT_MAX,
                "target map: expected coefficients of at most {COEFFICIENT_MAX} m, got {number}"
            );
        }
        Ok(TargetMap { coefficients })
    }

    /// Of x and y, term by term.
    pub fn coefficients(&self) -> &[[f32; 2]; TERMS] {
        &self.coefficients
    }

    /// Where the gripper should be for an object with these bounds.
    pub fn position(&self, bounds: &BoundingBox) -> [f32; 2] {
        let terms = terms(bounds);
        [0, 1].map(|axis| {
            let products = terms.iter().zip(&self.coefficients);
            products.map(|(term, of)| term * f64::from(of[axis])).sum::<f64>() as f32
        })
    }
}

/// What a position is a linear function of.
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

/// The maps of every instruction with enough training data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TargetModel {
    maps: BTreeMap<(String, Stage), TargetMap>,
}

/// Where the gripper should go from where it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictedTarget {
    /// What it heads for.
    pub stage: Stage,
    /// From the gripper, x and y in the base frame, metres.
    pub offset: [f32; 2],
}

impl TargetModel {
    /// Adds or replaces the map of a stage.
    pub fn insert(&mut self, instruction: &str, stage: Stage, map: TargetMap) {
        self.maps.insert((instruction.to_owned(), stage), map);
    }

    /// All maps with their instruction and stage.
    pub fn maps(&self) -> impl Iterator<Item = (&str, Stage, &TargetMap)> {
        self.maps.iter().map(|((instruction, stage), map)| (instruction.as_str(), *stage, map))
    }

    /// The target of a gripper at x, y; none when that is not known, the gripper heads for no object or the
    /// instruction has no map.
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
    /// How far the gripper is from it after moving by x and y, metres.
    pub fn distance(&self, motion: [f32; 2]) -> f32 {
        (self.offset[0] - motion[0]).hypot(self.offset[1] - motion[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_where_the_map_of_the_stage_puts_it_from_the_gripper() {
        let mut coefficients = [[0.0; 2]; TERMS];
        // x = 0.3 + 0.1 left, y = 0.2 top x bottom, sides in units of 64 pixels from the middle.
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
