//! `rever list`: lists tasks, variants, strategies, runs and servers.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use decision::{Strategy, TaskId, VARIANT_DEFAULT};
use evaluation::table::aligned_left;
use evaluation::task_names::short_names;
use protocol::{Description, TaskDescription};
use runtime::servers::{Host, LocalSource, ServerSource, Simulator};
use runtime::wire::Fleet;
use store::run;

use super::episodes;
use super::names::{FLEET_DEFAULT, endpoint, fleet};
use crate::files;

/// Maximum length of a command line in the list of runs.
const COMMAND_CHARACTERS_MAX: usize = 60;
/// How long to wait for further servers after the first.
const OTHERS_WAIT: Duration = Duration::from_secs(2);

/// List tasks, variants, strategies, runs or servers
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// List the tasks of a server, in their default variant
    Tasks(ServerArguments),
    /// List all variants of all tasks of a server
    Variants(ServerArguments),
    /// List the strategies that choose among candidates
    Strategies,
    /// List the runs in a folder
    Runs {
        /// Folder that holds the runs
        #[arg(default_value = "runs")]
        folder: PathBuf,
    },
    /// List the servers found at an address
    Servers {
        /// HOST:PORT of servers or of a zenoh router, separated by commas
        #[arg(long, value_name = "HOST:PORT", value_delimiter = ',', required = true, value_parser = endpoint)]
        connect: Vec<String>,
        /// Namespace: peers see each other only within the same fleet
        #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
        fleet: String,
    },
}

/// The servers that describe the tasks.
#[derive(Debug, Args)]
struct ServerArguments {
    /// Ask running servers: HOST:PORT of servers or of a zenoh router, separated by commas [default: start a server]
    #[arg(long, value_name = "HOST:PORT", value_delimiter = ',', value_parser = endpoint)]
    connect: Vec<String>,
    /// Namespace: peers see each other only within the same fleet
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
    fleet: String,
    /// Simulator to start
    #[arg(long, value_enum, default_value_t, conflicts_with = "connect")]
    simulator: Simulator,
    /// Python interpreter for the server, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
}

/// Prints the list.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let (rows, next) = match arguments.what {
        What::Tasks(servers) => {
            let is_default = |task: &TaskDescription| task.variant == VARIANT_DEFAULT;
            (tasks(&servers.ask(host)?, is_default), "rever evaluate --tasks NAME")
        }
        What::Variants(servers) => {
            (tasks(&servers.ask(host)?, |_| true), "rever evaluate --tasks NAME/VARIANT")
        }
        What::Strategies => (strategies(), "rever evaluate --strategies NAME,NAME"),
        What::Runs { folder } => (runs(&folder)?, "rever show RUN"),
        What::Servers { connect, fleet } => {
            let source = ServerSource { local: None, connect, listen: Vec::new(), fleet };
            (servers(&ask(&source)?), "rever evaluate --connect HOST:PORT")
        }
    };
    print!("{}", aligned_left(&rows));
    println!("next: {next}");
    Ok(())
}

impl ServerArguments {
    fn ask(self, host: &Host) -> Result<Fleet> {
        let (simulator, python) = (self.simulator, self.python);
        let start = || -> Result<LocalSource> {
            let installation = files::installation(host)?;
            Ok(LocalSource { count: 1, simulator, python, installation })
        };
        let local = self.connect.is_empty().then(start).transpose()?;
        ask(&ServerSource { local, connect: self.connect, listen: Vec::new(), fleet: self.fleet })
    }
}

/// The servers found within the time for discovery.
fn ask(source: &ServerSource) -> Result<Fleet> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let deployment = source.open(&runtime, 1)?;
    let fleet = runtime.block_on(deployment.first_servers());
    let fleet = fleet.map(|first| match source.local {
        Some(_) => first,
        // Other servers may answer a little later.
        None => runtime.block_on(deployment.network.servers(usize::MAX, OTHERS_WAIT)),
    });
    deployment.close(&runtime)?;
    fleet
}

fn tasks(fleet: &Fleet, is_listed: impl Fn(&TaskDescription) -> bool) -> Vec<Vec<String>> {
    let mut listed: BTreeMap<(usize, String), &TaskDescription> = BTreeMap::new();
    for server in fleet.servers.values() {
        for (index, task) in server.tasks.iter().enumerate().filter(|(_, task)| is_listed(task)) {
            listed.entry((index, format!("{}/{}", task.task, task.variant))).or_insert(task);
        }
    }
    let ids: Vec<TaskId> =
        listed.values().map(|task| TaskId::new(&task.task, &task.variant)).collect();
    let row = |(task, short): (&&TaskDescription, String)| {
        vec![
            short,
            TaskId::new(&task.task, &task.variant).to_string(),
            task.steps_max.to_string(),
            task.layouts.to_string(),
            task.instruction.clone(),
        ]
    };
    let rows = listed.values().zip(short_names(&ids)).map(row);
    headed(["name", "full name", "steps", "layouts", "instruction"], rows)
}

fn servers(fleet: &Fleet) -> Vec<Vec<String>> {
    let row = |server: &Description| {
        vec![
            server.server.clone(),
            format!("{} {}", server.simulator, server.simulator_version),
            server.sessions_max.to_string(),
            server.tasks.len().to_string(),
            String::new(),
        ]
    };
    let left_out = fleet.undescribed.iter().map(|(server, reason)| {
        vec![server.clone(), "skipped".to_owned(), String::new(), String::new(), reason.clone()]
    });
    let rows = fleet.servers.values().map(row).chain(left_out);
    headed(["server", "simulator", "sessions", "tasks", ""], rows)
}

fn strategies() -> Vec<Vec<String>> {
    let row = |strategy: Strategy| vec![strategy.to_string(), strategy.meaning().to_owned()];
    headed(["strategy", "executes"], Strategy::ALL.into_iter().map(row))
}

fn runs(folder: &Path) -> Result<Vec<Vec<String>>> {
    let entries =
        std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut rows = Vec::new();
    for entry in entries {
        let path = entry?.path();
        let Ok(header) = run::read_header(&path) else { continue };
        let planned = episodes::planned(&serde_json::to_value(&header)?);
        let started = header.starts.first().map_or("", |start| start.time.as_str());
        let command =
            header.starts.first().map(|start| start.command.get(1..).unwrap_or(&[]).join(" "));
        let date = started.get(..16).unwrap_or(started).replace('T', " ");
        let recorded = run::recorded(&path)?.len();
        rows.push(vec![
            date,
            path.display().to_string(),
            format!("{recorded} of {planned}"),
            shortened(&command.unwrap_or_default()),
        ]);
    }
    rows.sort();
    Ok(headed(["started", "run", "episodes", "command"], rows.into_iter()))
}

/// Truncates a command line at its end: the command and its main options come first.
fn shortened(command: &str) -> String {
    match command.char_indices().nth(COMMAND_CHARACTERS_MAX) {
        Some((end, _)) => format!("{}...", &command[..end]),
        None => command.to_owned(),
    }
}

fn headed<const N: usize>(
    head: [&str; N],
    rows: impl Iterator<Item = Vec<String>>,
) -> Vec<Vec<String>> {
    std::iter::once(head.map(str::to_owned).to_vec()).chain(rows).collect()
}
