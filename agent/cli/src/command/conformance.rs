//! `rever conformance`: tests a server against the specification.

use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;

use conformance::{Row, Verdict, test};
use runtime::servers::{Host, LocalSource, ServerSource, Simulator};

use super::WrongUsage;
use super::names::{FLEET_DEFAULT, endpoint, fleet};
use crate::files;

/// Test a server against the protocol's specification, rule by rule
#[derive(Debug, Args)]
pub struct Arguments {
    /// Start one of rever's servers and test it
    #[arg(long, value_enum, conflicts_with = "connect")]
    server: Option<Simulator>,
    /// Test a running server: HOST:PORT of the server or of a router
    #[arg(long, value_delimiter = ',', value_parser = endpoint)]
    connect: Vec<String>,
    /// Namespace: peers see each other only within the same fleet
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
    fleet: String,
    /// Id of the server to test, if there are several [default: the first]
    #[arg(long)]
    id: Option<String>,
    /// Python interpreter for the server, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
}

/// Sessions of a server that is started here. One of the rules opens all of them, so there are few.
const SESSIONS: usize = 4;

/// Prints the verdict on each rule as soon as it is known. Returns an error if a rule fails.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    if arguments.server.is_none() && arguments.connect.is_empty() {
        bail!(WrongUsage(
            "conformance: expected --server python|native|robosuite or --connect HOST:PORT, got neither".to_owned()
        ));
    }
    let start = |simulator| -> Result<LocalSource> {
        let installation = files::installation(host)?;
        Ok(LocalSource { count: 1, simulator, python: arguments.python, installation })
    };
    let source = ServerSource {
        local: arguments.server.map(start).transpose()?,
        connect: arguments.connect,
        listen: Vec::new(),
        fleet: arguments.fleet,
    };
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let id = arguments.id;
    let deployment = source.open(&runtime, SESSIONS)?;
    let rows = runtime.block_on(test(&deployment.network, id.as_deref(), &mut print));
    deployment.close(&runtime)?;
    let rows = rows?;
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(&rows)?;
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    }
    let count = |verdict| rows.iter().filter(|row| row.verdict == verdict).count();
    let (passed, failed) = (count(Verdict::Pass), count(Verdict::Fail));
    println!("{passed} passed, {failed} failed, {} not tested", count(Verdict::Skip));
    ensure!(
        failed == 0,
        "the server violates {failed} of {} rules of the specification",
        rows.len()
    );
    Ok(())
}

fn print(row: &Row) {
    let verdict = match row.verdict {
        Verdict::Pass => "pass",
        Verdict::Fail => "FAIL",
        Verdict::Skip => "skip",
    };
    println!("{verdict} {:<15} {}", row.name, row.rule);
    if let Some(reason) = &row.reason {
        println!("     {:<15} {reason}", "");
    }
}
