//! Where the gripper should go, by what the policy has said so far.
//!
//! Every candidate says where it sees the objects. One such box is a few pixels off, more when the gripper covers the
//! object; but objects stand still until they are touched, so the mean of all boxes so far is much better than any of
//! them. Which place of the gripper belongs to a box is learnt from where grasps were made and where successful episodes
//! let go. A candidate whose action brings the gripper nearer to that place agrees with what was said all along.

use std::collections::BTreeMap;

use anyhow::ensure;

use crate::policy::Reasoning;

/// Left, top, right, bottom in the square of 256 pixels.
pub type Bounds = [f32; 4];

/// Terms of a place's polynomial: 1, the four sides, their squares and products.
pub const TERMS: usize = 15;

/// Stages of a task that aim at a place.
pub const STAGES: usize = 2;

/// A box whose side is farther than this from the median of all is left out of the mean, in pixels.
const OUTLIER_PIXELS: f32 = 24.0;
/// Steps in a row that must be about grasping again before the object counts as dropped elsewhere.
const DROPPED_STEPS: u32 = 2;
/// Sides are counted from the middle of the square, in units of this many pixels.
const UNIT_PIXELS: f64 = 64.0;

/// What the gripper is after.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The first object of the reasoning, which is to be moved.
    Grasp,
    /// The second one, where the first is to go.
    Place,
}

impl Stage {
    /// In the order of a task.
    pub const ALL: [Stage; STAGES] = [Stage::Grasp, Stage::Place];

    /// By the first word of `SUBTASK:`; none when nothing is aimed at.
    fn of(subtask: &str) -> Option<Stage> {
        match subtask.split_whitespace().next()? {
            "reach" | "grasp" => Some(Stage::Grasp),
            "lift" | "move" | "release" => Some(Stage::Place),
            _ => None,
        }
    }
}

/// What a candidate says about the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Words {
    /// What it is about.
    pub stage: Option<Stage>,
    /// Of the object that each stage is after.
    pub bounds: [Bounds; STAGES],
}

impl Words {
    /// None when the reasoning does not name two objects.
    pub fn of(reasoning: &Reasoning) -> Option<Words> {
        let [first, second, ..] = reasoning.visible_objects.as_slice() else { return None };
        let bounds = [first, second].map(|object| object.bounding_box.map(f32::from));
        Some(Words { stage: Stage::of(&reasoning.subtask), bounds })
    }
}

/// What has been said in an episode so far.
#[derive(Clone, Debug, Default)]
pub struct Memory {
    said: [Vec<Bounds>; STAGES],
    is_placing: bool,
    grasping_steps: u32,
}

/// What the words of this step and of all before it come to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outlook {
    /// What most candidates are about.
    pub stage: Option<Stage>,
    /// Where the object that each stage is after stands.
    pub bounds: [Option<Bounds>; STAGES],
}

impl Memory {
    /// Takes in what the candidates of one step say.
    pub fn note(&mut self, words: &[Words]) -> Outlook {
        let count = |stage| words.iter().filter(|words| words.stage == stage).count();
        let stages = [None, Some(Stage::Place), Some(Stage::Grasp)];
        let stage = stages.into_iter().filter(|stage| count(*stage) > 0);
        let stage = stage.max_by_key(|stage| count(*stage)).flatten();
        match stage {
            Some(Stage::Grasp) => {
                self.grasping_steps += 1;
                if self.is_placing && self.grasping_steps >= DROPPED_STEPS {
                    self.is_placing = false;
                    self.said[0].clear();
                }
            }
            Some(Stage::Place) => {
                self.is_placing = true;
                self.grasping_steps = 0;
            }
            None => {}
        }
        if !words.is_empty() {
            let said = |stage: usize| words.iter().map(|words| words.bounds[stage]).collect();
            // What is being grasped stands still; what is held does not.
            if stage == Some(Stage::Grasp) && !self.is_placing {
                self.said[0].push(median(said(0)));
            }
            self.said[1].push(median(said(1)));
        }
        Outlook { stage, bounds: [0, 1].map(|stage| mean(&self.said[stage])) }
    }
}

/// Side by side.
fn median(boxes: Vec<Bounds>) -> Bounds {
    std::array::from_fn(|side| {
        let mut values: Vec<f32> = boxes.iter().map(|bounds| bounds[side]).collect();
        values.sort_by(f32::total_cmp);
        let (low, high) = ((values.len() - 1) / 2, values.len() / 2);
        (values[low] + values[high]) / 2.0
    })
}

/// Of the boxes that are near their median.
fn mean(boxes: &[Bounds]) -> Option<Bounds> {
    if boxes.is_empty() {
        return None;
    }
    let middle = median(boxes.to_vec());
    let is_near = |bounds: &&Bounds| {
        bounds.iter().zip(middle).all(|(side, middle)| (side - middle).abs() <= OUTLIER_PIXELS)
    };
    let near: Vec<&Bounds> = boxes.iter().filter(is_near).collect();
    if near.is_empty() {
        return Some(middle);
    }
    let mean =
        |side: usize| near.iter().map(|bounds| bounds[side]).sum::<f32>() / near.len() as f32;
    Some(std::array::from_fn(mean))
}

/// From a box to a place of the gripper: x and y in the robot's base frame, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    coefficients: [[f32; 2]; TERMS],
}

impl Place {
    /// Refuses what are no numbers.
    pub fn new(coefficients: [[f32; 2]; TERMS]) -> anyhow::Result<Place> {
        ensure!(
            coefficients.as_flattened().iter().all(|number| number.is_finite()),
            "place: expected finite coefficients, got NaN or infinity"
        );
        Ok(Place { coefficients })
    }

    /// Of x and y, term by term.
    pub fn coefficients(&self) -> &[[f32; 2]; TERMS] {
        &self.coefficients
    }

    /// Where the gripper should be for an object with these bounds.
    pub fn at(&self, bounds: &Bounds) -> [f32; 2] {
        let terms = terms(bounds);
        [0, 1].map(|axis| {
            let parts = terms.iter().zip(&self.coefficients);
            parts.map(|(term, of)| term * f64::from(of[axis])).sum::<f64>() as f32
        })
    }
}

/// What a place is a linear function of.
pub fn terms(bounds: &Bounds) -> [f64; TERMS] {
    let sides = bounds.map(|side| (f64::from(side) - 128.0) / UNIT_PIXELS);
    let mut terms = [1.0; TERMS];
    terms[1..5].copy_from_slice(&sides);
    let products = (0..4).flat_map(|left| (left..4).map(move |right| (left, right)));
    for (term, (left, right)) in terms[5..].iter_mut().zip(products) {
        *term = sides[left] * sides[right];
    }
    terms
}

/// The places of every instruction that enough was seen of.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Aims {
    places: BTreeMap<(String, Stage), Place>,
}

/// Where to go from here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// For what.
    pub stage: Stage,
    /// From the gripper, x and y in the base frame, metres.
    pub offset: [f32; 2],
}

impl Aims {
    /// Adds or replaces the place of a stage.
    pub fn insert(&mut self, instruction: &str, stage: Stage, place: Place) {
        self.places.insert((instruction.to_owned(), stage), place);
    }

    /// All places with their instruction and stage.
    pub fn places(&self) -> impl Iterator<Item = (&str, Stage, &Place)> {
        self.places
            .iter()
            .map(|((instruction, stage), place)| (instruction.as_str(), *stage, place))
    }

    /// The target of a gripper at x, y; none when nothing is aimed at or nothing is known of it.
    pub fn target(
        &self,
        instruction: &str,
        outlook: &Outlook,
        gripper: [f32; 2],
    ) -> Option<Target> {
        let stage = outlook.stage?;
        let bounds = outlook.bounds[stage as usize]?;
        let [x, y] = self.places.get(&(instruction.to_owned(), stage))?.at(&bounds);
        Some(Target { stage, offset: [x - gripper[0], y - gripper[1]] })
    }
}

impl Target {
    /// How far the gripper is from it after an action, metres.
    pub fn distance(&self, action: &[f32; 7]) -> f32 {
        (self.offset[0] - action[0]).hypot(self.offset[1] - action[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(stage: Option<Stage>, first: f32, second: f32) -> Words {
        let bounds = |left: f32| [left, 50.0, left + 10.0, 70.0];
        Words { stage, bounds: [bounds(first), bounds(second)] }
    }

    const GRASP: Option<Stage> = Some(Stage::Grasp);
    const PLACE: Option<Stage> = Some(Stage::Place);

    #[test]
    fn what_stands_still_is_averaged_without_freaks() {
        let mut memory = Memory::default();
        memory.note(&[words(GRASP, 100.0, 150.0), words(GRASP, 104.0, 150.0)]);
        memory.note(&[
            words(GRASP, 106.0, 200.0),
            words(None, 106.0, 152.0),
            words(GRASP, 250.0, 152.0),
        ]);
        let outlook = memory.note(&[words(GRASP, 10.0, 154.0)]);
        assert_eq!(outlook.stage, GRASP);
        // Medians 102, 106 and 10 of the first object, of which the last is a freak; 150, 152 and 154 of the second.
        assert_eq!(outlook.bounds[0], Some([104.0, 50.0, 114.0, 70.0]));
        assert_eq!(outlook.bounds[1], Some([152.0, 50.0, 162.0, 70.0]));
        // Nobody well-formed: nothing new is known, and nothing is aimed at.
        let outlook = memory.note(&[]);
        assert_eq!((outlook.stage, outlook.bounds[0]), (None, Some([104.0, 50.0, 114.0, 70.0])));
    }

    #[test]
    fn what_is_carried_is_remembered_where_it_was_and_forgotten_when_dropped() {
        let mut memory = Memory::default();
        let left = |outlook: Outlook| outlook.bounds[0].map(|bounds| bounds[0]);
        memory.note(&[words(GRASP, 100.0, 150.0)]);
        assert_eq!(left(memory.note(&[words(PLACE, 130.0, 150.0)])), Some(100.0));
        // One step that says otherwise may be a slip.
        assert_eq!(left(memory.note(&[words(GRASP, 140.0, 150.0)])), Some(100.0));
        assert_eq!(left(memory.note(&[words(GRASP, 144.0, 150.0)])), Some(144.0));
        let outlook = memory.note(&[words(GRASP, 146.0, 150.0), words(None, 146.0, 150.0)]);
        assert_eq!((outlook.stage, left(outlook)), (GRASP, Some(145.0)));
    }

    #[test]
    fn a_target_is_where_the_place_of_the_stage_lies_from_the_gripper() {
        let mut coefficients = [[0.0; 2]; TERMS];
        // x = 0.3 + 0.1 left, y = 0.2 top x bottom, sides in units of 64 pixels from the middle.
        coefficients[0][0] = 0.3;
        coefficients[1][0] = 0.1;
        coefficients[11][1] = 0.2;
        let place = Place::new(coefficients).expect("finite");
        let bounds = [192.0, 64.0, 200.0, 256.0];
        let mut aims = Aims::default();
        aims.insert("stack", Stage::Place, place);
        let outlook = Outlook { stage: PLACE, bounds: [None, Some(bounds)] };
        let target = aims.target("stack", &outlook, [0.3, -0.4]).expect("a target");
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(near(target.offset[0], 0.1) && near(target.offset[1], 0.0), "{target:?}");
        assert!(near(target.distance(&[0.1, 0.02, 9.0, 9.0, 9.0, 9.0, 1.0]), 0.02));
        assert_eq!(aims.target("other", &outlook, [0.0; 2]), None);
        assert_eq!(aims.target("stack", &Outlook { stage: GRASP, ..outlook }, [0.0; 2]), None);
        coefficients[3][0] = f32::NAN;
        assert!(Place::new(coefficients).is_err());
    }

    #[test]
    fn stages_are_read_off_the_subtask() {
        let reasoning = |subtask: &str, objects: usize| {
            let one = |left: u16| crate::policy::VisibleObject {
                name: "thing".to_owned(),
                bounding_box: [left, 2, 30, 4],
            };
            Reasoning {
                subtask: subtask.to_owned(),
                visible_objects: (0..objects as u16).map(one).collect(),
                ..Reasoning::default()
            }
        };
        let stage = |subtask| Words::of(&reasoning(subtask, 2)).and_then(|words| words.stage);
        assert_eq!(["reach the spoon", "grasp the spoon"].map(stage), [GRASP; 2]);
        assert_eq!(["lift the spoon", "move it", "release it"].map(stage), [PLACE; 3]);
        assert_eq!(stage("stay away"), None);
        assert_eq!(Words::of(&reasoning("reach it", 1)), None);
        let words = Words::of(&reasoning("reach it", 3)).expect("two objects and one more");
        assert_eq!(words.bounds, [[0.0, 2.0, 30.0, 4.0], [1.0, 2.0, 30.0, 4.0]]);
    }
}
