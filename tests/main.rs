//! The processes together. One binary: each file under `tests/` would be linked again on its own.

// What the tests below share: the built program, a run of it, a server, a bad wire.
mod evaluation;
mod harness;
mod relay;
mod server;

// The repository: its text, its README, its formats, lints and types.
mod lints;
mod readme;
mod tidy;

// The container files.
mod containers;

// The Python package's own tests.
mod python;

// The real client against real servers, on good wires and bad ones; servers that do not keep to the protocol.
mod bad_servers;
mod wire;

// Outcomes for observers, verifiers for followers.
mod published;

// The native simulator beside the Python one, and the test of servers.
mod simulators;

// The program away from its checkout; servers of this machine that freeze.
mod installation;
mod local_servers;

// Evaluations with the models that come with the program: results, kills, faults, the report.
mod whole_loop;

// The page of a run in a browser.
mod report_page;

// What decisions cost.
mod bench;

// A new verifier while a run goes on.
mod hot_swap;
