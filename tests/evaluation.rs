//! An evaluation by the built program: started, watched, killed, and read.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use store::record::EpisodeRecord;

use crate::harness::{python, rever, run, text, wait_for};

/// Maximum wait for an event of an evaluation that takes seconds on an idle machine.
pub const WAIT: Duration = Duration::from_secs(600);

/// The arguments and the files of one run.
pub struct Evaluation {
    folder: PathBuf,
    arguments: Vec<String>,
}

/// The running program; killed when dropped.
pub struct Running {
    child: Child,
}

impl Evaluation {
    /// `rever evaluate` with these arguments; all its files are in `folder`.
    pub fn new(folder: &Path, arguments: &[&str]) -> Evaluation {
        let arguments = arguments.iter().map(|&argument| argument.to_owned()).collect();
        Evaluation { folder: folder.to_owned(), arguments }
    }

    /// The folder of the run.
    pub fn run_folder(&self) -> PathBuf {
        self.folder.join("run")
    }

    /// The label store.
    pub fn labels(&self) -> PathBuf {
        self.folder.join("labels.sqlite")
    }

    /// Runs to the end and returns the result file.
    pub fn finish(&self) -> Value {
        let mut command = self.command();
        let output = run(&mut command);
        let said = text(&output);
        assert!(output.status.success(), "{command:?} ended with {}\n{said}", output.status);
        let json = std::fs::read(self.folder.join("result.json")).expect("a result file");
        serde_json::from_slice(&json).expect("the result file is JSON")
    }

    /// Starts the program without waiting for it. Its output goes to a file, because a pipe would
    /// fill up.
    pub fn start(&self) -> Running {
        let said =
            std::fs::File::create(self.folder.join("said.txt")).expect("a file for its words");
        let mut command = self.command();
        command.stdout(said.try_clone().expect("one file, two streams")).stderr(said);
        Running { child: command.stdin(Stdio::null()).spawn().expect("the program starts") }
    }

    /// Waits until at least `count` episodes are recorded by the running program.
    pub fn wait_for_records(&self, running: &mut Running, count: usize) {
        wait_for(&format!("{count} records"), WAIT, || {
            let ended = running.child.try_wait().expect("a child can be asked");
            let is_there = self.record_files().len() >= count;
            assert!(ended.is_none() || is_there, "it ended with {ended:?}: {}", self.words());
            is_there.then_some(())
        });
    }

    /// The bytes of every record by its file name.
    pub fn record_files(&self) -> BTreeMap<String, Vec<u8>> {
        let Ok(entries) = std::fs::read_dir(self.run_folder().join("episodes")) else {
            return BTreeMap::new();
        };
        let paths = entries.map(|entry| entry.expect("a readable folder").path());
        let whole = paths.filter(|path| path.extension().is_some_and(|ending| ending == "msgpack"));
        whole
            .map(|path| {
                let name = path.file_name().expect("a file has a name").to_string_lossy();
                (name.into_owned(), std::fs::read(&path).expect("a record can be read"))
            })
            .collect()
    }

    /// Every record by its episode id.
    pub fn records(&self) -> BTreeMap<String, EpisodeRecord> {
        let read = |name: &String| {
            let path = self.run_folder().join("episodes").join(name);
            let record = EpisodeRecord::read(&path).expect("a whole record");
            (record.identity.id(), record)
        };
        self.record_files().keys().map(read).collect()
    }

    /// The program's output since its start.
    pub fn words(&self) -> String {
        std::fs::read_to_string(self.folder.join("said.txt")).unwrap_or_default()
    }

    fn command(&self) -> Command {
        let mut command = rever();
        command
            .current_dir(&self.folder)
            .arg("evaluate")
            .args(&self.arguments)
            .args(["--out", "run", "--labels", "labels.sqlite", "--json", "result.json"])
            .arg("--python")
            .arg(&python().python);
        command
    }
}

impl Running {
    /// Kills it without any cleanup, like a crash.
    pub fn kill(mut self) {
        self.child.kill().expect("the program runs");
        self.child.wait().expect("a killed program ends");
    }

    /// Waits until it has ended by itself; returns whether it succeeded.
    pub fn succeeds(mut self) -> bool {
        let ended =
            wait_for("its end", WAIT, || self.child.try_wait().expect("a child can be asked"));
        ended.success()
    }

    /// The running server processes that it has started.
    pub fn servers(&self) -> Vec<u32> {
        let listed = std::fs::read_dir("/proc").expect("Linux lists its processes");
        let ids = listed.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
        ids.filter(|&id| parent_of(id) == Some(self.child.id())).collect()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Whether this process exists and has not ended.
pub fn is_alive(process: u32) -> bool {
    let state = status_of(process).and_then(|status| status.split(' ').next()?.chars().next());
    state.is_some_and(|state| state != 'Z')
}

/// Kills a process without any cleanup, like a crash.
pub fn kill(process: u32) {
    let killed = Command::new("kill").args(["-KILL", &process.to_string()]).status();
    assert!(killed.is_ok_and(|status| status.success()), "process {process} is there to be killed");
}

fn parent_of(process: u32) -> Option<u32> {
    status_of(process)?.split(' ').nth(1)?.parse().ok()
}

/// The text in /proc after the process's name, which may contain spaces: state, parent and more.
fn status_of(process: u32) -> Option<String> {
    let line = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    line.rsplit_once(") ").map(|(_, status)| status.to_owned())
}
