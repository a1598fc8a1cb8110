//! The serve subcommand: its arguments, the network it opens, and how it ends.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, ensure};
use clap::Args;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};
use zenoh::Wait;

use crate::server::{Server, ServerOptions};
use crate::tasks::{self, Task};
use crate::worlds::Worlds;

const PARENT_POLL: Duration = Duration::from_millis(500);
/// A wedged simulation is given up after that.
const FINISH_WAIT_MAX: Duration = Duration::from_secs(10);
/// A client waits this long for the router or agent that it is told to connect to.
const CLIENT_WAIT_MS: u32 = 30_000;

/// Offer the worlds over zenoh
#[derive(Debug, Args)]
#[group(skip)]
pub struct Arguments {
    /// A router or agent, as tcp/127.0.0.1:7447; may be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Where others may connect; may be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// Find others by multicast; without --listen, on every interface.
    #[arg(long)]
    multicast: bool,
    /// Offer these alone: TASK, TASK/VARIANT, TASK/all; every task in every variant if left out.
    #[arg(long, num_args = 1.., value_name = "TASK")]
    tasks: Vec<String>,
    /// Who meets whom.
    #[arg(long, default_value = "local")]
    fleet: String,
    /// At once.
    #[arg(long, default_value_t = 16)]
    sessions: u32,
    /// End when this parent process is gone.
    #[arg(long, value_name = "PID")]
    exit_with_parent: Option<u32>,
    /// The server's id is written there when it is ready.
    #[arg(long, value_name = "FILE")]
    id_file: Option<PathBuf>,
}

/// Serves until a signal comes or the parent is gone; prints `ready {server id}` when it can.
pub fn serve(arguments: Arguments, tasks: Vec<Task>) -> Result<()> {
    let Arguments { connect, listen, multicast, .. } = &arguments;
    ensure!(
        *multicast || !connect.is_empty() || !listen.is_empty(),
        "expected --connect, --listen or --multicast, got none"
    );
    let tasks = match arguments.tasks.as_slice() {
        [] => tasks,
        names => tasks::choose(tasks, names)?,
    };
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signals(Arc::clone(&stop))?;
    let network = zenoh::open(configuration(&arguments)?)
        .wait()
        .map_err(|error| anyhow!("cannot open the network: {error}"))?;
    let options = ServerOptions { fleet: arguments.fleet, sessions_max: arguments.sessions };
    let id_file = arguments.id_file;
    let ready = move |id: &str| -> Result<()> {
        if let Some(path) = &id_file {
            std::fs::write(path, id).with_context(|| format!("cannot write {}", path.display()))?;
        }
        println!("ready {id}");
        Ok(())
    };
    let (done, ended) = mpsc::channel();
    let (stopping, served_on) = (Arc::clone(&stop), network.clone());
    let simulate = move || {
        let worlds = Worlds::new(tasks, options.sessions_max as usize);
        let server = Server::new(&served_on, worlds, options);
        let result = server.and_then(|server| server.run(&stopping, ready));
        // Nobody listens once the process has given this thread up.
        let _ = done.send(result);
    };
    let thread = thread::Builder::new().name("simulation".to_owned()).spawn(simulate)?;
    let result = wait(&stop, arguments.exit_with_parent, &ended);
    ensure!(
        result.is_some() || thread.is_finished(),
        "the simulation did not end within {} s",
        FINISH_WAIT_MAX.as_secs()
    );
    thread.join().map_err(|_| anyhow!("the simulation thread panicked"))?;
    network.close().wait().map_err(|error| anyhow!("cannot close the network: {error}"))?;
    result.unwrap_or(Ok(()))
}

/// Ctrl-C and a polite end; whoever is not polite needs no handler.
fn stop_on_signals(stop: Arc<AtomicBool>) -> Result<()> {
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let mut signals = runtime.block_on(async {
        Ok::<_, std::io::Error>([
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
        ])
    })?;
    thread::Builder::new().name("signals".to_owned()).spawn(move || {
        let [interrupt, terminate] = &mut signals;
        runtime.block_on(async {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
        });
        stop.store(true, Ordering::Relaxed);
    })?;
    Ok(())
}

/// The simulation's result; none when it does not end though it was told to.
fn wait(
    stop: &AtomicBool,
    parent: Option<u32>,
    ended: &mpsc::Receiver<Result<()>>,
) -> Option<Result<()>> {
    while !stop.load(Ordering::Relaxed) {
        match ended.recv_timeout(PARENT_POLL) {
            Ok(result) => return Some(result),
            Err(mpsc::RecvTimeoutError::Disconnected) => return None,
            Err(mpsc::RecvTimeoutError::Timeout) => {}
        }
        if let Some(parent) = parent
            && std::os::unix::process::parent_id() != parent
        {
            tracing::info!("the parent process {parent} is gone");
            stop.store(true, Ordering::Relaxed);
        }
    }
    ended.recv_timeout(FINISH_WAIT_MAX).ok()
}

fn configuration(arguments: &Arguments) -> Result<zenoh::Config> {
    let mut configuration = zenoh::Config::default();
    let Arguments { connect, listen, multicast, .. } = arguments;
    for (key, value) in protocol::transport::settings(connect, listen, *multicast, CLIENT_WAIT_MS) {
        configuration
            .insert_json5(key, &value)
            .map_err(|error| anyhow!("zenoh does not take {key} = {value}: {error}"))?;
    }
    Ok(configuration)
}
