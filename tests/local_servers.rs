//! Local servers that freeze: detected by their heartbeats, killed, and replaced.

use std::path::Path;
use std::time::Duration;

use runtime::servers::{LocalServerOptions, LocalServers, Simulator};
use runtime::wire::{Network, NetworkOptions};
use rustix::process::{Pid, Signal, kill_process};
use tokio::runtime::Runtime;

use crate::harness::{simulator, wait_for};

/// Maximum wait for an event that takes seconds on an idle machine.
const WAIT: Duration = Duration::from_secs(120);
/// A server sends two heartbeats per second.
const SILENCE_MAX: Duration = Duration::from_secs(15);

#[test]
fn a_frozen_server_without_sessions_is_killed_and_replaced() {
    let runtime = Runtime::new().expect("a runtime");
    let options = NetworkOptions { fleet: "frozen".to_owned(), ..NetworkOptions::default() };
    let network = runtime.block_on(Network::open(options)).expect("a network");
    let options = LocalServerOptions {
        count: 1,
        connect: network.listening()[0].clone(),
        fleet: "frozen".to_owned(),
        sessions_each: 1,
        silence_max: SILENCE_MAX,
    };
    let beats = network.clone();
    let servers =
        LocalServers::start(simulator(Simulator::Python), &options, move |id| beats.last_beat(id));
    let servers = servers.expect("a server");
    let (id, process) = (servers.server_ids()[0].clone(), servers.process_ids()[0]);
    wait_for("a heartbeat", WAIT, || network.last_beat(&id));
    let frozen = i32::try_from(process).ok().and_then(Pid::from_raw).expect("a process id");
    kill_process(frozen, Signal::STOP).expect("it can be stopped");
    let new = wait_for("another server", WAIT, || {
        servers.server_ids().into_iter().find(|other| *other != id)
    });
    wait_for("its heartbeat", WAIT, || network.last_beat(&new));
    wait_for("the end of the frozen one", WAIT, || {
        (!Path::new(&format!("/proc/{process}")).exists()).then_some(())
    });
    assert_eq!(servers.restarts(), 1);
    drop(servers);
    runtime.block_on(network.close()).expect("the network ends");
}
