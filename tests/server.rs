//! A server process for a test: ends with the test, or is killed by it.

use std::net::{Ipv4Addr, TcpListener};

use crate::harness::{ReadyProgram, python, repository};

/// A server that runs until it is dropped.
pub struct Server {
    program: ReadyProgram,
    /// The server's id.
    pub id: String,
    /// The endpoint on which it listens, in addition to the one that it connects to.
    pub endpoint: String,
}

/// A loopback endpoint that is not in use.
pub fn free_endpoint() -> String {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("there is a free port");
    format!("tcp/{}", listener.local_addr().expect("a bound listener has an address"))
}

/// A zenoh router in this process, equivalent to a `zenohd` process.
pub async fn open_router(endpoint: &str) -> zenoh::Session {
    let mut configuration = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\"".to_owned()),
        ("listen/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        configuration.insert_json5(key, &value).expect("a known setting");
    }
    zenoh::open(configuration).await.expect("the router listens")
}

impl Server {
    /// Starts a server that connects to `connect`, and waits until it is ready.
    pub fn start(connect: &str, fleet: &str, arguments: &[&str]) -> Self {
        let endpoint = free_endpoint();
        let arguments = [&["--fleet", fleet, "--listen", &endpoint], arguments].concat();
        Self::start_with(&["-m", "rever_env"], connect, &arguments, &endpoint)
    }

    /// The same without listening, for a router at `connect`.
    pub fn start_behind_router(connect: &str, fleet: &str, arguments: &[&str]) -> Self {
        let arguments = [&["--fleet", fleet], arguments].concat();
        Self::start_with(&["-m", "rever_env"], connect, &arguments, connect)
    }

    /// A server with a defect of `broken_server.py`.
    pub fn start_broken_behind_router(connect: &str, fleet: &str, defect: &str) -> Self {
        let script = repository().join("tests/broken_server.py");
        let program = [script.to_str().expect("a path in UTF-8"), defect];
        Self::start_with(&program, connect, &["--fleet", fleet], connect)
    }

    fn start_with(program: &[&str], connect: &str, arguments: &[&str], endpoint: &str) -> Self {
        let mut command = python().command();
        command
            .args(program)
            .args(["serve", "--exit-with-parent", "--connect", connect])
            .args(arguments);
        let program = ReadyProgram::start(command);
        let id = program.name.clone();
        Self { program, id, endpoint: endpoint.to_owned() }
    }

    /// Kills it without any cleanup, like a crash.
    pub fn kill(&mut self) {
        self.program.kill();
    }
}
