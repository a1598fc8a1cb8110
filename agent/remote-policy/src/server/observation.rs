//! Finds image, state and instruction in a client's observation.

use anyhow::{Context, Result, bail, ensure};
use decision::{Image, Observation, PolicyInfo};

use crate::codec::{Array, Value, decode_image};

/// Maximum length of an instruction.
const INSTRUCTION_BYTES_MAX: usize = 4096;
/// Maximum number of numbers in a state.
const STATE_NUMBERS_MAX: usize = 1024;
/// Where clients of openpi, vla-eval and OpenVLA's script have the main camera, first match first. A
/// slash is part of a key or leads into a map.
const CAMERAS: [&str; 6] = [
    "observation/image",
    "images/primary",
    "image",
    "observation/exterior_image_1_left",
    "full_image",
    "images/cam_high",
];
/// The map of all cameras, whose first entry is taken if no name is known.
const IMAGES: &str = "images";
const STATES: [&str; 4] = ["observation/state", "states", "state", "proprio"];
const INSTRUCTIONS: [&str; 3] = ["prompt", "task_description", "instruction"];

/// Names that replace the well-known ones.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ObservationKeys {
    /// The camera's key, such as `observation/image`; a slash may lead into a map.
    pub camera: Option<String>,
    /// The state's key.
    pub state: Option<String>,
}

impl ObservationKeys {
    /// Reads an observation. The image is fitted to the policy's size.
    pub(super) fn read(&self, map: &Value<'_>, info: &PolicyInfo) -> Result<Observation> {
        Ok(Observation {
            image: self.image(map, info).context("observation")?,
            state: self.state(map).context("observation")?,
            instruction: instruction(map).context("observation")?,
            expert_action: None,
        })
    }

    fn image(&self, map: &Value<'_>, info: &PolicyInfo) -> Result<Image> {
        let value = match &self.camera {
            Some(name) => find(map, name).with_context(|| {
                format!("camera: expected the key {name:?}, got {}", map.key_names())
            })?,
            None => known_camera(map)?,
        };
        decision::fit_image(decode_image(value)?, info.image_size)
    }

    /// Empty if there is none and none was named.
    fn state(&self, map: &Value<'_>) -> Result<Vec<f32>> {
        let value = match &self.state {
            Some(name) => Some(find(map, name).with_context(|| {
                format!("state: expected the key {name:?}, got {}", map.key_names())
            })?),
            None => STATES.iter().find_map(|name| find(map, name)),
        };
        let Some(value) = value else { return Ok(Vec::new()) };
        let array = Array::from_value(value).context("state")?;
        let count: usize = array.shape.iter().product();
        ensure!(
            count <= STATE_NUMBERS_MAX,
            "state: expected at most {STATE_NUMBERS_MAX} numbers, got {count}"
        );
        let numbers = array.to_f32();
        ensure!(
            numbers.iter().all(|number| number.is_finite()),
            "state: expected finite numbers, got NaN or infinity"
        );
        Ok(numbers)
    }
}

fn known_camera<'a, 'b>(map: &'b Value<'a>) -> Result<&'b Value<'a>> {
    if let Some(value) = CAMERAS.iter().find_map(|name| find(map, name)) {
        return Ok(value);
    }
    if let Some(Value::Map(cameras)) = map.get(IMAGES)
        && let Some((_, first)) = cameras.first()
    {
        return Ok(first);
    }
    bail!(
        "expected an image under one of {}, got {}; name another with --camera",
        CAMERAS.join(", "),
        map.key_names()
    )
}

fn instruction(map: &Value<'_>) -> Result<String> {
    let value = INSTRUCTIONS.iter().find_map(|name| find(map, name)).with_context(|| {
        format!(
            "expected an instruction under one of {}, got {}",
            INSTRUCTIONS.join(", "),
            map.key_names()
        )
    })?;
    let text = value.as_text().context("instruction")?;
    let bytes = text.len();
    ensure!(
        (1..=INSTRUCTION_BYTES_MAX).contains(&bytes),
        "instruction: expected 1 to {INSTRUCTION_BYTES_MAX} bytes, got {bytes}"
    );
    Ok(text.to_owned())
}

/// The value of a key, or of a path through maps.
fn find<'a, 'b>(map: &'b Value<'a>, name: &str) -> Option<&'b Value<'a>> {
    map.get(name).or_else(|| {
        let (outer, inner) = name.split_once('/')?;
        find(map.get(outer)?, inner)
    })
}
