//! A run is a folder: its options and versions, one record per finished episode, an index, a lock.
//!
//! ```text
//! run.json            what was asked for, with which versions; a second start may only ask for more of the same
//! episodes/{id}.msgpack   the truth: one whole file per finished episode
//! index.sqlite        a summary of every record; rebuilt wherever it disagrees with the folder
//! faults.jsonl        one line per attempt that broke; never a label
//! videos/{id}.mp4     when asked for
//! lock                held by the one process that writes
//! ```

mod header;
mod index;

use std::collections::BTreeSet;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use protocol::Statistics;
use rusqlite::Connection;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use header::{RunHeader, read_header};

use crate::record::{DecisionRecord, EpisodeIdentity, EpisodeRecord};

const EPISODES: &str = "episodes";
const FAULTS: &str = "faults.jsonl";
const RECORD_SUFFIX: &str = ".msgpack";

/// A run that this process may write.
#[derive(Debug)]
pub struct Run {
    /// Where it lies, from the root.
    pub folder: PathBuf,
    /// What it is.
    pub header: RunHeader,
    index: Connection,
    _lock: Lock,
}

/// Released by the system when the process ends, however it ends.
#[derive(Debug)]
struct Lock(File);

impl Drop for Lock {
    /// A child that is being started holds a copy of every file until it runs its own program: closing ours would
    /// leave the run locked for that long, unlocking releases it at once.
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

/// What tables and labels need of a record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpisodeSummary {
    /// Which episode.
    pub identity: EpisodeIdentity,
    /// As of the last step.
    pub statistics: Statistics,
    /// The simulator and its version.
    pub simulator: String,
    /// Control steps.
    pub steps: u32,
    /// Decisions without a well-formed candidate.
    pub held_steps: u32,
    /// Malformed candidates of all decisions.
    pub malformed: u32,
    /// Candidates of all decisions.
    pub candidates: u32,
    /// Seconds from the reset to the last step.
    pub wall_secs: f32,
    /// Of each decision: its share of its batch's time.
    pub decision_ms: Vec<f32>,
    /// Of each decision: how many were made together with it, itself included.
    pub batch_size: Vec<u32>,
    /// Of each step.
    pub step_ms: Vec<f32>,
    /// Of each step.
    pub simulator_ms: Vec<f32>,
}

/// One attempt that broke.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultRecord {
    /// The episode that was to be run.
    pub identity: EpisodeIdentity,
    /// 1 for the first attempt of this process.
    pub attempt: u32,
    /// The server it broke on.
    pub server: String,
    /// What happened.
    pub reason: String,
    /// Whether the episode ran to its end without one well-formed candidate: the policy never acted.
    #[serde(default)]
    pub never_acted: bool,
}

impl Run {
    /// Starts a run in `folder`, or goes on with the one that is there when it has the same options and versions;
    /// more settings and more episodes are added to it.
    pub fn open(folder: &Path, options: Value, versions: Value) -> Result<Run> {
        let name = folder.display();
        std::fs::create_dir_all(folder.join(EPISODES))
            .with_context(|| format!("cannot make the run {name}"))?;
        let lock = lock(folder)?;
        let header = header::settle(folder, options, versions)?;
        sweep(folder)?;
        let index = index::open(folder)?;
        // Labels name records; they must be found from any working folder.
        let folder = std::path::absolute(folder).with_context(|| format!("cannot place {name}"))?;
        Ok(Run { folder, header, index, _lock: lock })
    }

    /// Makes an episode durable. Only after this may its label be published.
    pub fn record(&self, record: &EpisodeRecord) -> Result<()> {
        record.write(&record_path(&self.folder, &record.identity.id()))?;
        index::insert(&self.index, record)
    }

    /// Notes an attempt that broke.
    pub fn fault(&self, fault: &FaultRecord) -> Result<()> {
        let path = self.folder.join(FAULTS);
        let mut line = serde_json::to_vec(fault)?;
        line.push(b'\n');
        let mut file = OpenOptions::new().create(true).append(true).open(&path)?;
        file.write_all(&line)
            .and_then(|()| file.sync_all())
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// All recorded episodes, ordered by name.
    pub fn summaries(&self) -> Result<Vec<EpisodeSummary>> {
        index::summaries(&self.index)
    }

    /// Where videos of this run lie.
    pub fn video_path(&self, id: &str) -> PathBuf {
        video_path(&self.folder, id)
    }
}

/// All recorded episodes of a run that another process may be writing, ordered by name.
pub fn summaries(folder: &Path) -> Result<Vec<EpisodeSummary>> {
    index::summaries(&index::open(folder)?)
}

/// All attempts of a run that broke. A line that a killed process left unfinished is no fault.
pub fn faults(folder: &Path) -> Result<Vec<FaultRecord>> {
    let path = folder.join(FAULTS);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let whole = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let parsed = whole.map(|line| {
        serde_json::from_str(line).with_context(|| format!("{}: {line:?}", path.display()))
    });
    parsed.collect()
}

/// Where the record of an episode lies.
pub fn record_path(folder: &Path, id: &str) -> PathBuf {
    folder.join(EPISODES).join(format!("{id}{RECORD_SUFFIX}"))
}

/// Where the video of an episode lies, if there is one.
pub fn video_path(folder: &Path, id: &str) -> PathBuf {
    folder.join("videos").join(format!("{id}.mp4"))
}

/// The names of all recorded episodes: what the folder holds, whatever the index says.
pub fn recorded(folder: &Path) -> Result<BTreeSet<String>> {
    let episodes = folder.join(EPISODES);
    let entries = std::fs::read_dir(&episodes)
        .with_context(|| format!("cannot read {}", episodes.display()))?;
    let mut names = BTreeSet::new();
    for entry in entries {
        if let Some(id) =
            entry?.file_name().to_str().and_then(|name| name.strip_suffix(RECORD_SUFFIX))
        {
            names.insert(id.to_owned());
        }
    }
    Ok(names)
}

impl From<&EpisodeRecord> for EpisodeSummary {
    fn from(record: &EpisodeRecord) -> EpisodeSummary {
        let candidates = || record.decisions().flat_map(|decision| &decision.candidates);
        EpisodeSummary {
            identity: record.identity.clone(),
            statistics: record.statistics,
            simulator: record.versions.simulator.clone(),
            steps: record.steps.len() as u32,
            held_steps: record.decisions().filter(|decision| decision.chosen.is_none()).count()
                as u32,
            malformed: candidates().filter(|candidate| candidate.malformed.is_some()).count()
                as u32,
            candidates: candidates().count() as u32,
            wall_secs: record.wall_secs,
            decision_ms: record.decisions().map(DecisionRecord::milliseconds).collect(),
            batch_size: record.decisions().map(|decision| decision.batch_size).collect(),
            step_ms: record.steps.iter().map(|step| step.step_ms).collect(),
            simulator_ms: record.steps.iter().map(|step| step.simulator_ms).collect(),
        }
    }
}

fn lock(folder: &Path) -> Result<Lock> {
    let path = folder.join("lock");
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path);
    let file = file.with_context(|| format!("cannot open {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => Ok(Lock(file)),
        Err(TryLockError::WouldBlock) => {
            bail!("the run {} is being written by another process", folder.display())
        }
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

/// Removes what a killed process was writing.
fn sweep(folder: &Path) -> Result<()> {
    for entry in std::fs::read_dir(folder.join(EPISODES))? {
        let path = entry?.path();
        if path.extension().is_none_or(|extension| extension != "msgpack") {
            std::fs::remove_file(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
        }
    }
    let path = folder.join(FAULTS);
    if path.exists() {
        let text =
            std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1);
        let file = OpenOptions::new().write(true).open(&path)?;
        file.set_len(whole as u64).with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::tests::made_up;
    use serde_json::json;

    fn open(folder: &Path) -> Result<Run> {
        Run::open(folder, json!({"seed": 1, "settings": ["greedy"]}), json!({"policy": "cafe"}))
    }

    #[test]
    fn a_run_goes_on_with_what_it_has() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = open(folder.path()).expect("a run");
        run.record(&made_up(0)).expect("recorded");
        let name = run.header.run.clone();
        drop(run);
        let run = open(folder.path()).expect("the same run");
        assert_eq!(run.header.run, name);
        run.record(&made_up(1)).expect("recorded");
        let episodes = |summaries: Vec<EpisodeSummary>| -> Vec<u32> {
            summaries.iter().map(|summary| summary.identity.episode).collect()
        };
        assert_eq!(episodes(run.summaries().expect("summaries")), [0, 1]);
        assert_eq!(episodes(summaries(folder.path()).expect("while it is written")), [0, 1]);
        assert_eq!(recorded(folder.path()).expect("names").len(), 2);
    }

    #[test]
    fn two_processes_cannot_write_one_run() {
        let folder = tempfile::tempdir().expect("a folder");
        let _first = open(folder.path()).expect("a run");
        let error = open(folder.path()).expect_err("locked");
        assert!(error.to_string().ends_with("is being written by another process"), "{error}");
    }

    #[test]
    fn a_closed_run_is_free_while_a_starting_child_still_holds_its_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = open(folder.path()).expect("a run");
        let _held_by_the_child = run._lock.0.try_clone().expect("a copy");
        drop(run);
        open(folder.path()).expect("the same run");
    }

    #[test]
    fn the_index_is_rebuilt_wherever_it_disagrees() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = open(folder.path()).expect("a run");
        for episode in 0..3 {
            run.record(&made_up(episode)).expect("recorded");
        }
        let expected = run.summaries().expect("summaries");
        drop(run);
        let index = folder.path().join(index::INDEX);
        std::fs::remove_file(&index).expect("an index");
        assert_eq!(summaries(folder.path()).expect("rebuilt"), expected, "without an index");
        std::fs::write(&index, [0x5a; 4096]).expect("damaged");
        assert_eq!(summaries(folder.path()).expect("rebuilt"), expected, "with a damaged one");
        let last = record_path(folder.path(), &expected[2].identity.id());
        std::fs::remove_file(last).expect("a record");
        assert_eq!(
            summaries(folder.path()).expect("rebuilt"),
            expected[..2],
            "with too much in it"
        );
    }

    #[test]
    fn what_a_killed_process_left_unfinished_is_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = open(folder.path()).expect("a run");
        let fault = FaultRecord {
            identity: made_up(0).identity,
            attempt: 1,
            server: "s".into(),
            reason: "lost".into(),
            never_acted: false,
        };
        run.fault(&fault).expect("noted");
        drop(run);
        let half = folder.path().join(EPISODES).join(".tmpabc");
        std::fs::write(&half, b"half").expect("written");
        let mut lines =
            OpenOptions::new().append(true).open(folder.path().join(FAULTS)).expect("faults");
        lines.write_all(b"{\"identity\": {").expect("written");
        let run = open(folder.path()).expect("the same run");
        assert!(!half.exists());
        assert_eq!(faults(&run.folder).expect("faults"), std::slice::from_ref(&fault));
        run.fault(&fault).expect("noted");
        assert_eq!(faults(&run.folder).expect("faults"), [fault.clone(), fault]);
    }
}
