//! The serve subcommand: arguments, network and shutdown.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, ensure};
use clap::Args;
use protocol::{KeyError, Keys, limits, transport};
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};
use zenoh::Wait;

use crate::server::{Server, ServerOptions};
use crate::tasks::{self, Task};
use crate::worlds::Worlds;

const PARENT_POLL: Duration = Duration::from_millis(500);
/// Time after which a stuck simulation is abandoned.
const FINISH_WAIT_MAX: Duration = Duration::from_secs(10);
const CLOSE_WAIT_MAX: Duration = Duration::from_secs(3);
/// How long a client waits for its router or agent.
const CLIENT_WAIT_MS: u32 = 30_000;

/// Serve the Bridge tasks over zenoh until a signal arrives
#[derive(Debug, Args)]
#[group(skip)]
pub struct Arguments {
    #[command(flatten)]
    ways: Ways,
    /// Tasks to serve: TASK, TASK/VARIANT or TASK/all; by default all tasks in all variants.
    #[arg(long, num_args = 1.., value_name = "TASK")]
    tasks: Vec<String>,
    /// Namespace: peers see each other only within the same fleet.
    #[arg(long, value_name = "NAME", default_value = "local", value_parser = fleet)]
    fleet: String,
    /// Maximum number of concurrent sessions.
    #[arg(
        long, value_name = "COUNT", default_value_t = 16,
        value_parser = clap::value_parser!(u32).range(1..=limits::SESSIONS_MAX.into())
    )]
    sessions: u32,
    /// Exit when the process with this id is no longer the parent process.
    #[arg(long, value_name = "PID")]
    exit_with_parent: Option<u32>,
    /// Write the server's id into this file when it is ready.
    #[arg(long, value_name = "FILE")]
    id_file: Option<PathBuf>,
}

/// At least one of these is required.
#[derive(Debug, Args)]
#[group(required = true, multiple = true)]
struct Ways {
    /// Endpoint of a router or an agent to connect to, such as tcp/127.0.0.1:7447. Repeatable.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Endpoint to listen on, such as tcp/127.0.0.1:7448. Every peer that reaches it is trusted. Repeatable.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// Discover peers by multicast; without --listen, listen on every interface.
    #[arg(long)]
    multicast: bool,
}

/// Serves until a signal arrives or the parent process ends. Prints a line that starts with `ready
/// {server id}` when ready.
pub fn serve(arguments: Arguments, tasks: Vec<Task>) -> Result<()> {
    let tasks = match arguments.tasks.as_slice() {
        [] => tasks,
        names => tasks::choose(tasks, names)?,
    };
    if let Some(path) = &arguments.id_file {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        ensure!(
            folder.is_none_or(Path::is_dir),
            "--id-file {}: its folder does not exist",
            path.display()
        );
    }
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signals(Arc::clone(&stop))?;
    let network = zenoh::open(configuration(&arguments.ways)?)
        .wait()
        .map_err(|error| anyhow!("cannot open the network: {}", transport::in_words(error)))?;
    let offer = offer(&arguments, &tasks);
    let options = ServerOptions { fleet: arguments.fleet, sessions_max: arguments.sessions };
    let id_file = arguments.id_file;
    let ready = move |id: &str| -> Result<()> {
        if let Some(path) = &id_file {
            std::fs::write(path, id).with_context(|| format!("cannot write {}", path.display()))?;
        }
        println!("ready {id} {offer}");
        Ok(())
    };
    let (done, ended) = mpsc::channel();
    let (stopping, served_on) = (Arc::clone(&stop), network.clone());
    let simulate = move || {
        let worlds = Worlds::new(tasks, options.sessions_max as usize);
        let server = Server::new(&served_on, worlds, options);
        let result = server.and_then(|server| server.run(&stopping, ready));
        // The receiver is gone if the process has abandoned this thread.
        let _ = done.send(result);
    };
    let thread = thread::Builder::new().name("simulation".to_owned()).spawn(simulate)?;
    let result = wait(&stop, arguments.exit_with_parent, &ended);
    ensure!(
        result.is_some() || thread.is_finished(),
        "the simulation thread did not end within {} s",
        FINISH_WAIT_MAX.as_secs()
    );
    thread.join().map_err(|_| anyhow!("the simulation thread panicked"))?;
    close(network)?;
    result.unwrap_or(Ok(()))
}

/// Closes the network. If zenoh waits too long for a peer that does not read, the end of the
/// process closes it.
fn close(network: zenoh::Session) -> Result<()> {
    let (done, closed) = mpsc::channel();
    thread::Builder::new().name("closing".to_owned()).spawn(move || {
        // The receiver is gone if this took too long.
        let _ = done.send(network.close().wait());
    })?;
    match closed.recv_timeout(CLOSE_WAIT_MAX) {
        Ok(result) => result
            .map_err(|error| anyhow!("cannot close the network: {}", transport::in_words(error))),
        Err(_) => Ok(()),
    }
}

/// Checks that a fleet's name is valid in keys.
fn fleet(name: &str) -> Result<String, KeyError> {
    Keys::new(name).map(|_| name.to_owned())
}

/// The endpoints and the tasks of the server.
fn offer(arguments: &Arguments, tasks: &[Task]) -> String {
    let Arguments { ways: Ways { connect, listen, multicast }, fleet, .. } = arguments;
    let mut ways = Vec::new();
    if !listen.is_empty() {
        ways.push(format!("listening on {}", listen.join(", ")));
    }
    if !connect.is_empty() {
        ways.push(format!("connected to {}", connect.join(", ")));
    }
    if *multicast {
        ways.push("discovered by multicast".to_owned());
    }
    let variants = tasks.chunk_by(|one, next| one.id.task == next.id.task);
    let tasks: Vec<String> = variants
        .map(|some| match some {
            [task] => task.id.to_string(),
            some => format!("{} in {} variants", some[0].id.task, some.len()),
        })
        .collect();
    format!("{} (fleet {fleet}): {}", ways.join(", "), tasks.join(", "))
}

/// Sets `stop` on SIGINT and SIGTERM.
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

/// The simulation's result; `None` if it does not end after `stop` is set.
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
            tracing::info!("the parent process {parent} has ended");
            stop.store(true, Ordering::Relaxed);
        }
    }
    ended.recv_timeout(FINISH_WAIT_MAX).ok()
}

fn configuration(ways: &Ways) -> Result<zenoh::Config> {
    let mut configuration = zenoh::Config::default();
    let Ways { connect, listen, multicast } = ways;
    let settings = transport::settings(
        connect,
        listen,
        *multicast,
        CLIENT_WAIT_MS,
        limits::SERVER_MESSAGE_BYTES_MAX,
    );
    for (key, value) in settings {
        configuration.insert_json5(key, &value).map_err(|error| {
            let cause = transport::in_words(error);
            anyhow!("zenoh rejects the setting {key} = {value}: {cause}")
        })?;
    }
    Ok(configuration)
}
