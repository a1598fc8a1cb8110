//! A server process for a test: ends with the test, or is killed by it.

use std::io::{BufRead, BufReader};
use std::net::{Ipv4Addr, TcpListener};
use std::process::{Child, Stdio};

use crate::harness::{python, repository};

/// A server that runs until it is dropped.
pub struct Server {
    child: Child,
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
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        let mut child = command.spawn().expect("the server starts");
        let stdout = child.stdout.take().expect("its standard output is piped");
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("its standard output is text");
        let mut words = line.split_whitespace();
        let id = words.next().filter(|word| *word == "ready").and_then(|_| words.next());
        let id = id.map(str::to_owned);
        let id =
            id.unwrap_or_else(|| panic!("expected a line `ready` of the server, got {line:?}"));
        Self { child, id, endpoint: endpoint.to_owned() }
    }

    /// Kills it without any cleanup, like a crash.
    pub fn kill(&mut self) {
        self.child.kill().expect("the server runs");
        self.child.wait().expect("a killed child ends");
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have ended already, which is fine.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
