//! The header of a run: its options, its builds, and which of them may change when the run is
//! resumed.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::SystemTime;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::RunRequest;
use crate::durable::write_whole;
use crate::provenance::Build;

const HEADER: &str = "run.json";

/// Version of the file; a header of another version is refused.
const HEADER_VERSION: u32 = 2;

/// Options that do not affect the course of an episode: they may grow when a run is resumed.
const GROWING: [&str; 2] = ["settings", "episodes"];

/// The file `run.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunHeader {
    /// Version of the file's format.
    pub version: u32,
    /// The run's name in records, labels and zenoh keys.
    pub run: String,
    /// Everything that determines the results, by name.
    pub options: Value,
    /// Versions when the run was started, by name.
    pub versions: Value,
    /// What the candidates of a policy server are read with; absent for a local policy. Its digest and
    /// its profile determine it, so that it is not compared when a run is resumed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub served: Option<Value>,
    /// The distinct command lines and builds that started or resumed the run, in order.
    pub starts: Vec<RunStart>,
}

/// A start or resumption that differs from all earlier ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunStart {
    /// When, RFC 3339.
    pub time: String,
    /// The command line, word by word.
    pub command: Vec<String>,
    /// The program.
    pub build: Build,
}

impl RunHeader {
    /// Names the other builds that contributed to the run; `None` if all had the sources of
    /// `build`.
    pub fn other_builds(&self, build: &Build) -> Option<String> {
        let mut others: Vec<String> = Vec::new();
        for start in self.starts.iter().filter(|start| !start.build.has_sources_of(build)) {
            let other = start.build.to_string();
            if !others.contains(&other) {
                others.push(other);
            }
        }
        let run = &self.run;
        (!others.is_empty()).then(|| {
            format!(
                "the run {run} contains episodes of other builds: {}; this build is {build}",
                others.join(", ")
            )
        })
    }
}

/// Reads `run.json`.
pub fn read_header(folder: &Path) -> Result<RunHeader> {
    let path = folder.join(HEADER);
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("{} is not a run: cannot read {HEADER}", folder.display()))?;
    let what = || format!("{} is not the header of a run", path.display());
    let header: Value = serde_json::from_str(&text).with_context(what)?;
    ensure!(
        header["version"] == json!(HEADER_VERSION),
        "{}: expected run version {HEADER_VERSION}, got {}; choose another folder (--out)",
        path.display(),
        header["version"]
    );
    serde_json::from_value(header).with_context(what)
}

/// Writes the header of a new run, or checks the existing header in `folder` and adds to it.
pub fn settle(request: &RunRequest, has_records: bool) -> Result<RunHeader> {
    let RunRequest { folder, options, versions, command, build, .. } = request;
    let name = folder.display();
    let mut header = if folder.join(HEADER).exists() {
        let header = read_header(folder)?;
        let check = || -> Result<()> {
            ensure_same("option", &header.options, options)?;
            ensure_same("version", &header.versions, versions)
        };
        check().with_context(|| format!("cannot resume the run {name}"))?;
        header
    } else {
        // Records name their run, but only the header has the options that they were run with.
        ensure!(
            !has_records,
            "the run {name} has records but no {HEADER}; choose another folder (--out)"
        );
        RunHeader {
            version: HEADER_VERSION,
            run: unique_name(folder),
            options: options.clone(),
            versions: versions.clone(),
            served: request.served.clone(),
            starts: Vec::new(),
        }
    };
    if let Some(notice) = header.other_builds(build) {
        tracing::warn!("{notice}");
    }
    let is_known = |start: &RunStart| start.command == *command && start.build == *build;
    let is_new = !header.starts.iter().any(is_known);
    if is_new {
        let time = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        header.starts.push(RunStart { time, command: command.clone(), build: build.clone() });
    }
    if grow(&mut header.options, options) || is_new {
        write_whole(&folder.join(HEADER), &serde_json::to_vec_pretty(&header)?)?;
    }
    Ok(header)
}

/// Adds requested settings and episodes that are not in the header yet; true if there were any.
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

/// The folder's name and eight random digits, so that runs with the same folder name have different
/// labels.
fn unique_name(folder: &Path) -> String {
    let name =
        folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let allowed = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    let name: String =
        name.chars().map(|letter| if allowed(letter) { letter } else { '_' }).take(48).collect();
    format!("{name}-{:08x}", rand::random::<u32>())
}

/// Reports the first difference. Results of different options must not be mixed in one table.
fn ensure_same(what: &str, existing: &Value, asked: &Value) -> Result<()> {
    let (Value::Object(existing), Value::Object(asked)) = (existing, asked) else {
        bail!("{what}s: expected JSON objects, got {existing} (recorded) and {asked} (requested)");
    };
    let names: BTreeSet<&String> = existing.keys().chain(asked.keys()).collect();
    for name in names.into_iter().filter(|name| !GROWING.contains(&name.as_str())) {
        let (was, is) =
            (existing.get(name).unwrap_or(&Value::Null), asked.get(name).unwrap_or(&Value::Null));
        ensure!(
            was == is,
            "{what} {name}: started with {was}, got {is}; choose another folder (--out) for a new run"
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

    fn settled(folder: &Path, options: Value, versions: Value) -> Result<RunHeader> {
        let folder = folder.to_path_buf();
        settle(&RunRequest { folder, options, versions, ..RunRequest::default() }, false)
    }

    #[test]
    fn other_options_and_versions_are_refused_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let policy = |digest: &str| json!({ "policy": digest });
        settled(folder.path(), options(1, &["greedy"], 24), policy("cafe")).expect("a new run");
        let check = |options: Value, versions: Value, expected: &str| {
            let error = settled(folder.path(), options, versions).expect_err(expected);
            assert!(format!("{error:#}").contains(expected), "{error:#}");
        };
        check(options(2, &["greedy"], 24), policy("cafe"), "option seed: started with 1, got 2");
        check(
            json!({"settings": ["greedy"], "episodes": 24}),
            policy("cafe"),
            "option seed: started with 1, got null",
        );
        check(
            options(1, &["greedy"], 24),
            policy("beef"),
            "version policy: started with \"cafe\", got \"beef\"",
        );
    }

    #[test]
    fn a_run_grows_by_settings_and_episodes() {
        let folder = tempfile::tempdir().expect("a folder");
        let ask = |settings: &[&str], episodes: u32| {
            let header = settled(folder.path(), options(1, settings, episodes), json!({}));
            let header = header.expect("a header");
            assert_eq!(header, read_header(folder.path()).expect("written"));
            header.options
        };
        assert_eq!(ask(&["greedy"], 24), options(1, &["greedy"], 24));
        assert_eq!(ask(&["sample", "greedy"], 10), options(1, &["greedy", "sample"], 24));
        assert_eq!(ask(&["sample"], 100), options(1, &["greedy", "sample"], 100));
    }

    #[test]
    fn every_command_and_build_of_a_run_is_recorded_once_and_other_builds_are_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let start = |build: &Build, episodes: &str| {
            let command = ["rever", "evaluate", "--episodes", episodes].map(str::to_owned).to_vec();
            let request = RunRequest {
                folder: folder.path().to_path_buf(),
                options: json!({}),
                versions: json!({}),
                command,
                build: build.clone(),
                ..RunRequest::default()
            };
            settle(&request, false).expect("a header")
        };
        let build = |described, date| Build::new("1.2.3", described, date);
        let (first, rebuilt) = (build("cafe", "Monday"), build("cafe", "Tuesday"));
        start(&first, "1");
        start(&first, "1");
        assert_eq!(start(&first, "2").starts.len(), 2, "another command");
        let header = start(&rebuilt, "2");
        assert_eq!(header.starts.len(), 3);
        assert_eq!(header.starts[2].build, rebuilt);
        assert_eq!(header.other_builds(&first), None, "from the same sources");
        let other = build("beef-dirty", "Friday");
        assert_eq!(
            header.other_builds(&other).expect("said"),
            format!(
                "the run {} contains episodes of other builds: rever 1.2.3 (commit cafe, built Monday), \
                 rever 1.2.3 (commit cafe, built Tuesday); this build is rever 1.2.3 (commit beef-dirty, built Friday)",
                header.run
            )
        );
        let header = start(&other, "2");
        assert_eq!(header.other_builds(&other).map(|said| said.contains("Monday")), Some(true));
        let edited = build("beef-dirty", "Saturday");
        assert!(!edited.has_sources_of(&other), "both from changed sources");
        assert!(!Build::default().has_sources_of(&first));
    }

    #[test]
    fn a_header_of_another_version_and_records_without_one_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let request = RunRequest { folder: folder.path().to_path_buf(), ..RunRequest::default() };
        let error = settle(&request, true).expect_err("no header");
        assert!(error.to_string().contains("has records but no run.json"), "{error}");
        let old = json!({"run": "a", "options": {}, "versions": {}});
        std::fs::write(folder.path().join(HEADER), old.to_string()).expect("written");
        let error = settle(&request, true).expect_err("old").to_string();
        assert!(error.contains("run.json: expected run version 2, got null"), "{error}");
    }
}
