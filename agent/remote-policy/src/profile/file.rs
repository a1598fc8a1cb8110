//! Loading a profile: one of those that come with the program, or a file.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use sha2::{Digest, Sha256};

use super::{Camera, Gripper, ImageInput, Profile, Rotation, StateValue};
use crate::Wire;
use crate::codec::extension::{self, Announcement};
use crate::codec::{DIMENSIONS_MAX, IMAGE_SIDE_MAX, STEPS_MAX};

/// Names and contents of the profiles that come with the program.
const SHIPPED: [(&str, &str); 4] = [
    ("bridge", include_str!("../../profiles/bridge.toml")),
    ("libero", include_str!("../../profiles/libero.toml")),
    ("rever", include_str!("../../profiles/rever.toml")),
    ("simpler", include_str!("../../profiles/simpler.toml")),
];
/// Names of the profiles that come with the program.
pub const NAMES: [&str; 4] = [SHIPPED[0].0, SHIPPED[1].0, SHIPPED[2].0, SHIPPED[3].0];
/// Maximum size of a profile's file.
const BYTES_MAX: u64 = 64 * 1024;
/// Maximum wait for an answer.
const ANSWER_SECS_MAX: u64 = 3600;
/// A name that is at least this similar is suggested.
const SIMILARITY_MIN: f64 = 0.7;

impl Profile {
    /// Loads a profile by its name, or from a file.
    pub fn load(name: &str) -> Result<Profile> {
        let load = || {
            if let Some((_, text)) = SHIPPED.iter().find(|(known, _)| *known == name) {
                return Profile::parse(text);
            }
            let path = Path::new(name);
            if !path.is_file() {
                let suggestion = suggestion(name, NAMES.into_iter());
                bail!("expected one of {} or a file, got neither{suggestion}", NAMES.join(", "));
            }
            let bytes = std::fs::metadata(path)?.len();
            ensure!(bytes <= BYTES_MAX, "expected at most {BYTES_MAX} bytes, got {bytes}");
            Profile::parse(&std::fs::read_to_string(path)?)
        };
        load().with_context(|| format!("profile {name}"))
    }

    /// Parses and checks a profile.
    pub fn parse(text: &str) -> Result<Profile> {
        let profile: Profile = toml::from_str(text).map_err(|error| refusal(&error))?;
        profile.check()?;
        Ok(profile)
    }

    /// Identity of the mapping, in hexadecimal.
    pub fn digest(&self) -> Result<String> {
        let text = serde_json::to_string(self).context("profile")?;
        Ok(format!("{:x}", Sha256::digest(text)))
    }

    /// Checks that the profile has what a wire needs.
    pub fn check_wire(&self, wire: Wire) -> Result<()> {
        let is_sent = |image: &ImageInput| image.names.on(wire).is_some();
        ensure!(
            self.images.iter().any(is_sent),
            "images: expected a name on the wire {wire}, got none; add one to the profile"
        );
        ensure!(
            self.prompt.names.on(wire).is_some(),
            "prompt: expected a name on the wire {wire}, got none; add one to the profile"
        );
        self.check_names(wire)
    }

    /// Refuses two values under one name.
    fn check_names(&self, wire: Wire) -> Result<()> {
        let images = self.images.iter().filter_map(|image| image.names.on(wire));
        let state = self.state.iter().filter_map(|state| state.names.on(wire));
        let fields = state.chain(self.prompt.names.on(wire)).chain([extension::KEY]);
        // vla-eval has its images in a map of their own.
        let maps: Vec<Vec<&str>> = match wire {
            Wire::VlaEval => vec![images.collect(), fields.chain(["images"]).collect()],
            Wire::OpenPi => vec![images.chain(fields).collect()],
            Wire::Act => vec![images.chain(fields).chain(["unnorm_key"]).collect()],
        };
        for mut names in maps {
            names.sort_unstable();
            let twice = names.windows(2).find(|pair| pair[0] == pair[1]);
            if let Some(pair) = twice {
                bail!("expected every name once on the wire {wire}, got {} twice", pair[0]);
            }
        }
        Ok(())
    }

    /// With the image size and the action scale that a server announces.
    pub fn adapted(mut self, announced: &Announcement) -> Result<Profile> {
        if let Some((height, width)) = announced.image_size {
            self.camera = Camera { height, width };
            for image in &mut self.images {
                (image.height, image.width) = (height, width);
            }
        }
        if let Some(scale) = &announced.action_scale {
            self.actions.scale.clone_from(scale);
        }
        self.check().context("announced by the server")?;
        Ok(self)
    }

    fn check(&self) -> Result<()> {
        check_sides("camera", self.camera.height, self.camera.width)?;
        for image in &self.images {
            check_sides("images", image.height, image.width)?;
        }
        let values = self.state.as_ref().map_or(&[][..], |state| &state.values);
        ensure!(
            values.len() == 1 || !values.contains(&StateValue::All),
            "state.values: expected \"all\" to stand alone, got {} values",
            values.len()
        );
        let has_fingers = values
            .iter()
            .any(|value| matches!(value, StateValue::Finger | StateValue::FingerNegative));
        let opening = self.state.as_ref().map_or(0.0, |state| state.finger_open_metres);
        ensure!(
            !has_fingers || (opening.is_finite() && opening > 0.0),
            "state.finger_open_metres: expected a positive number for finger and finger-negative, got {opening}"
        );
        let secs = self.server.answer_secs_max;
        ensure!(
            (1..=ANSWER_SECS_MAX).contains(&secs),
            "server.answer_secs_max: expected 1 to {ANSWER_SECS_MAX}, got {secs}"
        );
        self.check_actions()
    }

    fn check_actions(&self) -> Result<()> {
        let actions = &self.actions;
        let dimensions = actions.dimensions;
        ensure!(
            (1..=DIMENSIONS_MAX).contains(&dimensions),
            "actions.dimensions: expected 1 to {DIMENSIONS_MAX}, got {dimensions}"
        );
        ensure!(
            (1..=STEPS_MAX).contains(&actions.execute),
            "actions.execute: expected 1 to {STEPS_MAX}, got {}",
            actions.execute
        );
        ensure!(
            actions.rotation == Rotation::None || dimensions >= 6,
            "actions.rotation: expected at least 6 dimensions, got {dimensions}"
        );
        let has_gripper = actions.gripper != Gripper::None;
        let others = dimensions - usize::from(has_gripper);
        let lists = [("actions.scale", Some(&actions.scale), dimensions)].into_iter().chain([
            ("actions.normalised.low", actions.normalised.as_ref().map(|range| &range.low), others),
            (
                "actions.normalised.high",
                actions.normalised.as_ref().map(|range| &range.high),
                others,
            ),
        ]);
        for (name, list, expected) in lists {
            let Some(list) = list else { continue };
            ensure!(
                list.len() == expected,
                "{name}: expected {expected} numbers, got {}",
                list.len()
            );
            ensure!(
                list.iter().all(|number| number.is_finite()),
                "{name}: expected finite numbers"
            );
        }
        ensure!(
            actions.scale.iter().all(|scale| *scale >= 0.0),
            "actions.scale: expected numbers of at least 0"
        );
        if let Gripper::Nearest { open, closed } | Gripper::Linear { open, closed } =
            actions.gripper
        {
            let is_range = open.is_finite() && closed.is_finite() && open != closed;
            ensure!(is_range, "actions.gripper: expected two numbers, got {open} and {closed}");
        }
        Ok(())
    }
}

fn check_sides(name: &str, height: usize, width: usize) -> Result<()> {
    let are_right = [height, width].iter().all(|side| (1..=IMAGE_SIDE_MAX).contains(side));
    ensure!(
        are_right,
        "{name}: expected sides of 1 to {IMAGE_SIDE_MAX} pixels, got {height} x {width}"
    );
    Ok(())
}

/// The parser's message names the known fields; the most similar one is suggested.
fn refusal(error: &toml::de::Error) -> anyhow::Error {
    let message = error.message();
    let mut quoted = message.split('`').skip(1).step_by(2);
    let unknown = quoted.next().unwrap_or_default();
    let suggestion =
        if message.starts_with("unknown") { suggestion(unknown, quoted) } else { String::new() };
    anyhow!("{}{suggestion}", error.to_string().trim_end())
}

fn suggestion<'a>(unknown: &str, known: impl Iterator<Item = &'a str>) -> String {
    let similarity = |name: &str| strsim::jaro_winkler(unknown, name);
    let nearest = known.max_by(|a, b| similarity(a).total_cmp(&similarity(b)));
    match nearest.filter(|name| similarity(name) >= SIMILARITY_MIN) {
        Some(name) => format!("; did you mean {name}?"),
        None => String::new(),
    }
}
