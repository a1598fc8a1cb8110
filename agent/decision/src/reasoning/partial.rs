//! Reads a chain of thought that does not have ECoT's form: sections may be missing, empty, repeated
//! or unreadable. ECoT's training data has such reasoning, and its reference executes the action
//! after it.

use std::fmt;

use super::{COORDINATE_MAX, Reasoning, TAGS, VisibleObject, tags_in};

/// A section that was not read, or not completely, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unread {
    /// The section's tag.
    pub tag: &'static str,
    /// What was expected and what was found.
    pub reason: String,
}

impl fmt::Display for Unread {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {}", self.tag, self.reason)
    }
}

impl Reasoning {
    /// Reads the sections that are there. [`Reasoning::unread`] lists the others; it is empty
    /// exactly if [`Reasoning::parse`] accepts the text.
    pub fn read(text: &str) -> Reasoning {
        let malformed = match Reasoning::parse(text) {
            Ok(reasoning) => return reasoning,
            Err(malformed) => malformed,
        };
        let mut reader = Reader { text, tags: tags_in(text), unread: Vec::new() };
        let [task, plan, objects, subtask_reasoning, subtask, move_reasoning, movement, gripper] =
            std::array::from_fn(|index| reader.section(TAGS[index]));
        reader.check_action();
        let visible_objects = reader.objects(objects);
        let gripper_position = reader.points(gripper);
        let mut unread = reader.unread;
        if unread.is_empty() {
            // Sections in another order, or text before the first one.
            unread.push(Unread { tag: TAGS[0], reason: malformed.reason });
        }
        Reasoning {
            task: task.to_owned(),
            plan: plan.to_owned(),
            visible_objects,
            subtask_reasoning: subtask_reasoning.to_owned(),
            subtask: subtask.to_owned(),
            move_reasoning: move_reasoning.to_owned(),
            movement: movement.to_owned(),
            gripper_position,
            unread,
        }
    }
}

/// A text, its tags with their offsets, and what could not be read so far.
struct Reader<'a> {
    text: &'a str,
    tags: Vec<(usize, &'static str)>,
    unread: Vec<Unread>,
}

impl<'a> Reader<'a> {
    fn note(&mut self, tag: &'static str, reason: impl Into<String>) {
        self.unread.push(Unread { tag, reason: reason.into() });
    }

    /// The text of a section's first occurrence up to the next tag; empty if there is none.
    fn section(&mut self, tag: &'static str) -> &'a str {
        let mut places = (0..self.tags.len()).filter(|&place| self.tags[place].1 == tag);
        let (first, others) = (places.next(), places.count());
        let Some(first) = first else {
            self.note(tag, "expected this section, got none");
            return "";
        };
        if others > 0 {
            self.note(tag, format!("expected once, got {} times; the first is read", others + 1));
        }
        let text = self.after(first);
        if text.is_empty() {
            self.note(tag, "expected text, got none");
        }
        text
    }

    /// The text between a tag and the next one.
    fn after(&self, place: usize) -> &'a str {
        let (offset, tag) = self.tags[place];
        let end = self.tags.get(place + 1).map_or(self.text.len(), |(offset, _)| *offset);
        self.text[offset + tag.len()..end].trim()
    }

    /// `ACTION:` must be there once, with nothing after it.
    fn check_action(&mut self) {
        const ACTION: &str = TAGS[TAGS.len() - 1];
        let places: Vec<usize> =
            (0..self.tags.len()).filter(|&place| self.tags[place].1 == ACTION).collect();
        match places.as_slice() {
            [] => self.note(ACTION, "expected this tag, got none"),
            [only] => {
                let text = self.after(*only);
                if !text.is_empty() {
                    self.note(ACTION, format!("expected action tokens, got {text:?}"));
                }
            }
            several => {
                let count = several.len();
                self.note(ACTION, format!("expected once, got {count} times"));
            }
        }
    }

    /// The objects up to the first unreadable one: their order tells what is to be moved where.
    fn objects(&mut self, text: &str) -> Vec<VisibleObject> {
        const TAG: &str = TAGS[2];
        let mut objects = Vec::new();
        let mut rest = text;
        while !rest.is_empty() {
            let expected = || format!("expected name [x1, y1, x2, y2], got {rest:?}");
            let Some((name, after)) = rest.split_once('[') else {
                self.note(TAG, expected());
                break;
            };
            let Some((numbers, after)) = after.split_once(']') else {
                self.note(TAG, expected());
                break;
            };
            let name = name.trim().trim_start_matches(',').trim_start();
            let numbers = self.coordinates(TAG, numbers);
            let (Some(Ok(bounding_box)), false) =
                (numbers.map(<[u16; 4]>::try_from), name.is_empty())
            else {
                self.note(TAG, expected());
                break;
            };
            objects.push(VisibleObject { name: name.to_owned(), bounding_box });
            rest = after.trim_start_matches(',').trim_start();
        }
        objects
    }

    /// `[x, y]`, or a flat list of several points; an odd number at the end is dropped.
    fn points(&mut self, text: &str) -> Vec<[u16; 2]> {
        const TAG: &str = TAGS[7];
        if text.is_empty() {
            return Vec::new();
        }
        let inner = text.trim_start_matches('[').trim_end_matches(']');
        let Some(numbers) = self.coordinates(TAG, inner) else {
            self.note(TAG, format!("expected [x, y], got {text:?}"));
            return Vec::new();
        };
        if numbers.len() % 2 != 0 {
            self.note(TAG, format!("expected pairs, got {} numbers", numbers.len()));
        }
        numbers.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect()
    }

    /// Numbers, moved to the border of the image where they lie outside; `None` if one is no number.
    fn coordinates(&mut self, tag: &'static str, text: &str) -> Option<Vec<u16>> {
        let mut numbers = Vec::new();
        for word in text.split(',') {
            let number: f64 = word.trim().parse().ok().filter(|number: &f64| number.is_finite())?;
            let inside = number.clamp(0.0, f64::from(COORDINATE_MAX)).round();
            if inside != number {
                let border = format!("expected a coordinate from 0 to {COORDINATE_MAX}");
                self.note(tag, format!("{border}, got {}; read as {inside}", word.trim()));
            }
            numbers.push(inside as u16);
        }
        Some(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "TASK: put the spoon on the towel PLAN: reach it, grasp it \
        VISIBLE OBJECTS: spoon [10, 24, 36, 48], blue towel [60, 62, 90, 256] \
        SUBTASK REASONING: it is not grasped SUBTASK: reach the spoon \
        MOVE REASONING: it is there MOVE: move left \
        GRIPPER POSITION: [120, 84, 121, 85] ACTION:";

    fn unread(text: &str) -> Vec<String> {
        Reasoning::read(text).unread.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_whole_text_is_read_as_the_strict_parser_reads_it() {
        assert_eq!(Ok(Reasoning::read(GOOD)), Reasoning::parse(GOOD));
        assert_eq!(unread(GOOD), Vec::<String>::new());
    }

    #[test]
    fn everything_that_ecot_may_write_is_read_as_far_as_possible() {
        fn check(from: &str, to: &str, expected: &str) -> Reasoning {
            let text = GOOD.replacen(from, to, 1);
            assert_ne!(text, GOOD, "{from:?} is in the good text");
            assert!(Reasoning::parse(&text).is_err(), "{text}");
            assert_eq!(unread(&text), [expected], "{text}");
            Reasoning::read(&text)
        }
        let objects = "spoon [10, 24, 36, 48], blue towel [60, 62, 90, 256]";
        let read = check(objects, "", "VISIBLE OBJECTS: expected text, got none");
        assert!(read.visible_objects.is_empty());
        assert_eq!(read.subtask, "reach the spoon");
        let border = "expected a coordinate from 0 to 256";
        let read =
            check("24, 36", "-3, 36", &format!("VISIBLE OBJECTS: {border}, got -3; read as 0"));
        assert_eq!(read.visible_objects[0].bounding_box, [10, 0, 36, 48]);
        assert_eq!(read.visible_objects.len(), 2);
        let read = check(
            "84, 121",
            "261, 121",
            &format!("GRIPPER POSITION: {border}, got 261; read as 256"),
        );
        assert_eq!(read.gripper_position, [[120, 256], [121, 85]]);
        check("[120, 84, 121, 85]", "", "GRIPPER POSITION: expected text, got none");
        let read = check(", 85]", "]", "GRIPPER POSITION: expected pairs, got 3 numbers");
        assert_eq!(read.gripper_position, [[120, 84]]);
        let read = check(
            "36, 48]",
            "36]",
            "VISIBLE OBJECTS: expected name [x1, y1, x2, y2], got \"spoon [10, 24, 36], blue towel [60, 62, 90, 256]\"",
        );
        assert!(read.visible_objects.is_empty(), "the order of objects has a meaning");
        check("PLAN: reach it, grasp it ", "", "PLAN: expected this section, got none");
        check(" ACTION:", "", "ACTION: expected this tag, got none");
        check("ACTION:", "ACTION: now", "ACTION: expected action tokens, got \"now\"");
        check("ACTION:", "MOVE: up ACTION:", "MOVE: expected once, got 2 times; the first is read");
    }

    #[test]
    fn a_text_without_any_section_lists_all_of_them() {
        let read = Reasoning::read("I am a robot");
        assert_eq!(read.unread.len(), TAGS.len());
        assert_eq!(Reasoning { unread: Vec::new(), ..read }, Reasoning::default());
    }

    #[test]
    fn sections_in_another_order_are_read_and_marked() {
        let text = GOOD.replacen("TASK: put the spoon on the towel ", "", 1);
        let text = text.replacen(" ACTION:", " TASK: put it there ACTION:", 1);
        let read = Reasoning::read(&text);
        assert_eq!(read.task, "put it there");
        assert_eq!(unread(&text), ["TASK: expected TASK:, got PLAN:"]);
    }
}
