//! What a run was asked for, and what a second start may add to it.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::record::write_whole;

const HEADER: &str = "run.json";

/// What an episode's course does not depend on: a run may grow by it.
const GROWING: [&str; 2] = ["settings", "episodes"];

/// The file `run.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunHeader {
    /// The run's name everywhere: in records, labels and zenoh keys.
    pub run: String,
    /// Everything that decides the results, by name.
    pub options: Value,
    /// Versions at the start, by name.
    pub versions: Value,
}

/// Reads `run.json`.
pub fn read_header(folder: &Path) -> Result<RunHeader> {
    let path = folder.join(HEADER);
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("{} is not a run: cannot read {HEADER}", folder.display()))?;
    serde_json::from_str(&text).with_context(|| format!("{} is not a run's header", path.display()))
}

/// Writes the header of a new run, or checks that of the one in `folder` and notes what is added to it.
pub fn settle(folder: &Path, options: Value, versions: Value) -> Result<RunHeader> {
    let path = folder.join(HEADER);
    let header = if path.exists() {
        let mut header = read_header(folder)?;
        let check = || -> Result<()> {
            ensure_same("option", &header.options, &options)?;
            ensure_same("version", &header.versions, &versions)
        };
        check().with_context(|| format!("the run {} exists", folder.display()))?;
        if !grow(&mut header.options, &options) {
            return Ok(header);
        }
        header
    } else {
        RunHeader { run: unique_name(folder), options, versions }
    };
    write_whole(&path, &serde_json::to_vec_pretty(&header)?)?;
    Ok(header)
}

/// Adds the settings and episodes that are asked for and not noted yet; whether there were any.
fn grow(noted: &mut Value, asked: &Value) -> bool {
    let mut grown = false;
    if let (Some(noted), Some(asked)) =
        (noted["settings"].as_array_mut(), asked["settings"].as_array())
    {
        for setting in asked {
            if !noted.contains(setting) {
                noted.push(setting.clone());
                grown = true;
            }
        }
    }
    if asked["episodes"].as_u64() > noted["episodes"].as_u64() {
        noted["episodes"] = json!(asked["episodes"]);
        grown = true;
    }
    grown
}

/// The folder's name and eight random digits: runs of the same name in different places must not share labels.
fn unique_name(folder: &Path) -> String {
    let name =
        folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let allowed = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    let name: String =
        name.chars().map(|letter| if allowed(letter) { letter } else { '_' }).take(48).collect();
    format!("{name}-{:08x}", rand::random::<u32>())
}

/// Names the first thing that differs: mixing two sets of options in one table would be worse than stopping.
fn ensure_same(what: &str, existing: &Value, asked: &Value) -> Result<()> {
    let (Value::Object(existing), Value::Object(asked)) = (existing, asked) else {
        bail!("{what}s: expected names and values, got {existing} and {asked}");
    };
    let names: BTreeSet<&String> = existing.keys().chain(asked.keys()).collect();
    for name in names.into_iter().filter(|name| !GROWING.contains(&name.as_str())) {
        let (was, is) =
            (existing.get(name).unwrap_or(&Value::Null), asked.get(name).unwrap_or(&Value::Null));
        ensure!(
            was == is,
            "{what} {name}: it was started with {was}, got {is}; choose another --out for another run"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(seed: u32, settings: &[&str], episodes: u32) -> Value {
        json!({"seed": seed, "settings": settings, "episodes": episodes})
    }

    #[test]
    fn other_options_and_versions_are_refused_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let policy = |digest: &str| json!({ "policy": digest });
        settle(folder.path(), options(1, &["greedy"], 24), policy("cafe")).expect("a new run");
        let check = |options: Value, versions: Value, expected: &str| {
            let error = settle(folder.path(), options, versions).expect_err(expected);
            assert!(format!("{error:#}").contains(expected), "{error:#}");
        };
        check(
            options(2, &["greedy"], 24),
            policy("cafe"),
            "option seed: it was started with 1, got 2",
        );
        check(
            json!({"settings": ["greedy"], "episodes": 24}),
            policy("cafe"),
            "option seed: it was started with 1, got null",
        );
        check(
            options(1, &["greedy"], 24),
            policy("beef"),
            "version policy: it was started with \"cafe\", got \"beef\"",
        );
    }

    #[test]
    fn a_run_grows_by_settings_and_episodes() {
        let folder = tempfile::tempdir().expect("a folder");
        let ask = |settings: &[&str], episodes: u32| {
            let settled = settle(folder.path(), options(1, settings, episodes), json!({}));
            let header = settled.expect("a header");
            assert_eq!(header, read_header(folder.path()).expect("written"));
            header.options
        };
        assert_eq!(ask(&["greedy"], 24), options(1, &["greedy"], 24));
        assert_eq!(ask(&["sample", "greedy"], 10), options(1, &["greedy", "sample"], 24));
        assert_eq!(ask(&["sample"], 100), options(1, &["greedy", "sample"], 100));
    }
}
