//! A server process for a test: ended with the test, killed when the test says so.

use std::io::{BufRead, BufReader};
use std::net::{Ipv4Addr, TcpListener};
use std::process::{Child, Stdio};

use crate::harness::python;

/// Running until it is dropped.
pub struct Server {
    child: Child,
    /// The server's id.
    pub id: String,
    /// Where it listens, beside what it connects to.
    pub endpoint: String,
}

/// An endpoint of this machine alone that nobody uses now.
pub fn free_endpoint() -> String {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("there is a free port");
    format!("tcp/{}", listener.local_addr().expect("a bound listener has an address"))
}

impl Server {
    /// Starts a server that connects to `connect`, and waits until it says that it is ready.
    pub fn start(connect: &str, fleet: &str, arguments: &[&str]) -> Self {
        let endpoint = free_endpoint();
        Self::start_with(connect, fleet, &[&["--listen", &endpoint], arguments].concat(), &endpoint)
    }

    /// The same, listening nowhere: for a router that `connect` names.
    pub fn start_behind_router(connect: &str, fleet: &str) -> Self {
        Self::start_with(connect, fleet, &[], connect)
    }

    fn start_with(connect: &str, fleet: &str, arguments: &[&str], endpoint: &str) -> Self {
        let mut command = python().command();
        command
            .args(["-m", "rever_env", "serve", "--exit-with-parent", "--connect", connect])
            .args(["--fleet", fleet])
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        let mut child = command.spawn().expect("the server starts");
        let stdout = child.stdout.take().expect("its standard output is piped");
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("its standard output is text");
        let id = line.strip_prefix("ready ").map(|id| id.trim_end().to_owned());
        let id =
            id.unwrap_or_else(|| panic!("expected a line `ready` of the server, got {line:?}"));
        Self { child, id, endpoint: endpoint.to_owned() }
    }

    /// As a crash would: nothing is cleaned up.
    pub fn kill(&mut self) {
        self.child.kill().expect("the server runs");
        self.child.wait().expect("a killed child ends");
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may be dead already, which is what matters here.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
