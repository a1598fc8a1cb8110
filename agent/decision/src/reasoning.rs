//! The chain of thought as data. [`Reasoning::parse`] is strict: each of ECoT's tags must occur
//! exactly once and in order. [`Reasoning::read`] takes what is there.

mod partial;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use partial::Unread;

/// ECoT's tags in order. `ACTION:` ends the text; action tokens follow it.
pub const TAGS: [&str; 9] = [
    "TASK:",
    "PLAN:",
    "VISIBLE OBJECTS:",
    "SUBTASK REASONING:",
    "SUBTASK:",
    "MOVE REASONING:",
    "MOVE:",
    "GRIPPER POSITION:",
    "ACTION:",
];

/// Largest coordinate in the image of 256 x 256 pixels; ECoT's boxes may end at its border.
const COORDINATE_MAX: u16 = 256;

/// The reasoning of a policy before its action.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reasoning {
    /// The whole task as text.
    pub task: String,
    /// The steps of the plan.
    pub plan: String,
    /// Visible objects. The shipped model always names the object to move first and its destination
    /// second.
    pub visible_objects: Vec<VisibleObject>,
    /// Why this step of the plan is the current one.
    pub subtask_reasoning: String,
    /// The current step of the plan.
    pub subtask: String,
    /// Why the robot makes this movement.
    pub move_reasoning: String,
    /// The text of `MOVE:`, which is a keyword here.
    pub movement: String,
    /// Pixel coordinates (x, y) in an image of 256 x 256 pixels: the gripper's position and, in
    /// ECoT, its future positions.
    pub gripper_position: Vec<[u16; 2]>,
    /// The sections that were not read, or not completely. Empty for a text in ECoT's form. Records
    /// hold them as text.
    #[serde(skip)]
    pub unread: Vec<Unread>,
}

/// An object and its bounding box in an image of 256 x 256 pixels.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VisibleObject {
    /// The name of the object in the text.
    pub name: String,
    /// Left, top, right, bottom.
    pub bounding_box: [u16; 4],
}

/// Why a candidate is not a reasoning followed by an action.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Malformed {
    /// What was expected and what was found.
    pub reason: String,
}

impl Malformed {
    /// A malformed candidate with this reason.
    pub fn new(reason: impl Into<String>) -> Malformed {
        Malformed { reason: reason.into() }
    }
}

impl fmt::Display for Malformed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.reason)
    }
}

impl std::error::Error for Malformed {}

impl Reasoning {
    /// Parses the text from the first tag to `ACTION:`.
    pub fn parse(text: &str) -> Result<Reasoning, Malformed> {
        let [task, plan, objects, subtask_reasoning, subtask, move_reasoning, movement, gripper] =
            sections(text)?;
        Ok(Reasoning {
            task: task.to_string(),
            plan: plan.to_string(),
            visible_objects: visible_objects(objects)?,
            subtask_reasoning: subtask_reasoning.to_string(),
            subtask: subtask.to_string(),
            move_reasoning: move_reasoning.to_string(),
            movement: movement.to_string(),
            gripper_position: gripper_position(gripper)?,
            unread: Vec::new(),
        })
    }
}

/// The texts between the tags.
fn sections(text: &str) -> Result<[&str; 8], Malformed> {
    let found = tags_in(text);
    for (index, expected) in TAGS.iter().enumerate() {
        match found.get(index) {
            Some((_, tag)) if tag == expected => {}
            Some((_, tag)) => {
                return Err(Malformed::new(format!("expected {expected}, got {tag}")));
            }
            None => return Err(Malformed::new(format!("expected {expected}, got the end"))),
        }
    }
    if let Some((_, tag)) = found.get(TAGS.len()) {
        return Err(Malformed::new(format!(
            "expected the end of the text after \"ACTION:\", got {tag}"
        )));
    }
    let before = text[..found[0].0].trim();
    if !before.is_empty() {
        return Err(Malformed::new(format!("expected TASK: first, got {before:?}")));
    }
    let (last, tag) = found[TAGS.len() - 1];
    let after = text[last + tag.len()..].trim();
    if !after.is_empty() {
        return Err(Malformed::new(format!(
            "expected action tokens after \"ACTION:\", got {after:?}"
        )));
    }
    let mut sections = [""; 8];
    for (index, section) in sections.iter_mut().enumerate() {
        let (start, tag) = found[index];
        *section = text[start + tag.len()..found[index + 1].0].trim();
        if section.is_empty() {
            return Err(Malformed::new(format!("expected text after {tag:?}, got none")));
        }
    }
    Ok(sections)
}

/// Index in [`TAGS`] of the last tag that ends after byte `from`, or `None`.
pub fn last_tag(text: &str, from: usize) -> Option<usize> {
    let found = tags_in(text).into_iter().rev().find(|(at, tag)| at + tag.len() > from);
    found.and_then(|(_, tag)| TAGS.iter().position(|known| *known == tag))
}

/// All tags with their byte offsets. A tag starts the text or follows white space; of several tags
/// the longest matches.
fn tags_in(text: &str) -> Vec<(usize, &'static str)> {
    let mut found = Vec::new();
    let mut position = 0;
    while position < text.len() {
        let starts = position == 0 || text[..position].ends_with(char::is_whitespace);
        let rest = &text[position..];
        let tag =
            TAGS.iter().filter(|tag| starts && rest.starts_with(**tag)).max_by_key(|t| t.len());
        match tag {
            Some(tag) => {
                found.push((position, *tag));
                position += tag.len();
            }
            None => position += rest.chars().next().map_or(1, char::len_utf8),
        }
    }
    found
}

/// `name [x1, y1, x2, y2], name [x1, y1, x2, y2]`
fn visible_objects(text: &str) -> Result<Vec<VisibleObject>, Malformed> {
    let mut objects = Vec::new();
    let mut rest = text;
    while !rest.is_empty() {
        let expected = || {
            Malformed::new(format!(
                "expected name [x1, y1, x2, y2] in VISIBLE OBJECTS, got {rest:?}"
            ))
        };
        let (name, after) = rest.split_once('[').ok_or_else(expected)?;
        let (numbers, after) = after.split_once(']').ok_or_else(expected)?;
        let bounding_box = coordinates(numbers)?.try_into().map_err(|_| expected())?;
        let name = name.trim();
        if name.is_empty() {
            return Err(expected());
        }
        objects.push(VisibleObject { name: name.to_string(), bounding_box });
        rest = match after.strip_prefix(',') {
            Some(more) if !more.trim().is_empty() => more.trim_start(),
            None if after.is_empty() => after,
            _ => return Err(expected()),
        };
    }
    Ok(objects)
}

/// `[x, y]`, or a flat list of several points.
fn gripper_position(text: &str) -> Result<Vec<[u16; 2]>, Malformed> {
    let expected = || Malformed::new(format!("expected [x, y] in GRIPPER POSITION, got {text:?}"));
    let inner = text.strip_prefix('[').and_then(|text| text.strip_suffix(']'));
    let numbers = coordinates(inner.ok_or_else(expected)?)?;
    if numbers.len() % 2 != 0 {
        return Err(expected());
    }
    Ok(numbers.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect())
}

fn coordinates(text: &str) -> Result<Vec<u16>, Malformed> {
    let number = |text: &str| {
        let text = text.trim();
        let digits = text.bytes().all(|byte| byte.is_ascii_digit());
        let number = text.parse::<u16>().ok().filter(|&n| digits && n <= COORDINATE_MAX);
        number.ok_or_else(|| {
            Malformed::new(format!(
                "expected a coordinate from 0 to {COORDINATE_MAX}, got {text:?}"
            ))
        })
    };
    text.split(',').map(number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = " TASK: put the spoon on the towel PLAN: reach the spoon, grasp it \
        VISIBLE OBJECTS: spoon [10, 24, 36, 48], blue towel [60, 62, 90, 256] \
        SUBTASK REASONING: the spoon is not grasped yet SUBTASK: reach the spoon \
        MOVE REASONING: the gripper must go there MOVE: move left down \
        GRIPPER POSITION: [120, 84] ACTION:";

    #[test]
    fn a_well_formed_text_is_parsed_completely() {
        let object =
            |name: &str, bounding_box| VisibleObject { name: name.to_string(), bounding_box };
        let expected = Reasoning {
            task: "put the spoon on the towel".to_string(),
            plan: "reach the spoon, grasp it".to_string(),
            visible_objects: vec![
                object("spoon", [10, 24, 36, 48]),
                object("blue towel", [60, 62, 90, 256]),
            ],
            subtask_reasoning: "the spoon is not grasped yet".to_string(),
            subtask: "reach the spoon".to_string(),
            move_reasoning: "the gripper must go there".to_string(),
            movement: "move left down".to_string(),
            gripper_position: vec![[120, 84]],
            unread: Vec::new(),
        };
        assert_eq!(Reasoning::parse(GOOD), Ok(expected));
    }

    #[test]
    fn gripper_positions_of_several_steps_parse() -> Result<(), Malformed> {
        let text = GOOD.replace("[120, 84]", "[120, 84, 121, 85, 3, 0]");
        let expected = vec![[120, 84], [121, 85], [3, 0]];
        assert_eq!(Reasoning::parse(&text)?.gripper_position, expected);
        Ok(())
    }

    #[test]
    fn every_kind_of_malformed_text_is_refused_with_a_reason() {
        fn check(from: &str, to: &str, expected: &str) {
            let text = GOOD.replacen(from, to, 1);
            assert_ne!(text, GOOD, "{from:?} is in the good text");
            match Reasoning::parse(&text) {
                Err(malformed) => assert_eq!(malformed.to_string(), expected, "{text}"),
                Ok(_) => panic!("expected a refusal of {text}"),
            }
        }
        check(GOOD, "", "expected TASK:, got the end");
        check(" ACTION:", "", "expected ACTION:, got the end");
        check("PLAN:", "PLANS", "expected PLAN:, got VISIBLE OBJECTS:");
        check("SUBTASK REASONING:", "SUBTASK:", "expected SUBTASK REASONING:, got SUBTASK:");
        check(" MOVE: move", " MOVE REASONING: move", "expected MOVE:, got MOVE REASONING:");
        check(" PLAN:", " PLAN: a PLAN:", "expected VISIBLE OBJECTS:, got PLAN:");
        check(
            "ACTION:",
            "ACTION: TASK:",
            "expected the end of the text after \"ACTION:\", got TASK:",
        );
        check(" TASK:", "so TASK:", "expected TASK: first, got \"so\"");
        check("ACTION:", "ACTION: now", "expected action tokens after \"ACTION:\", got \"now\"");
        check("MOVE: move left down", "MOVE:", "expected text after \"MOVE:\", got none");
        check(
            "[120, 84]",
            "[120, 84, 3]",
            "expected [x, y] in GRIPPER POSITION, got \"[120, 84, 3]\"",
        );
        check("[120, 84]", "120, 84", "expected [x, y] in GRIPPER POSITION, got \"120, 84\"");
        check("84]", "300]", "expected a coordinate from 0 to 256, got \"300\"");
        check("84]", "+4]", "expected a coordinate from 0 to 256, got \"+4\"");
        check("84]", "]", "expected a coordinate from 0 to 256, got \"\"");
        let objects = "expected name [x1, y1, x2, y2] in VISIBLE OBJECTS, got";
        let all = "\"spoon [10, 24, 36, 48] blue towel [60, 62, 90, 256]\"";
        check("48], b", "48] b", &format!("{objects} {all}"));
        let last = "\"blue towel [60, 62, 90]\"";
        check("90, 256]", "90]", &format!("{objects} {last}"));
        check("blue towel [", "[", &format!("{objects} \"[60, 62, 90, 256]\""));
        check("256] SUB", "256], SUB", &format!("{objects} \"blue towel [60, 62, 90, 256],\""));
    }
}
