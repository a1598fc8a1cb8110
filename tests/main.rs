//! The integration tests in one binary, because each file under `tests/` would otherwise be linked
//! separately.

// Shared by the tests below: the built program, a run of it, a server, an unreliable network.
mod evaluation;
mod harness;
mod relay;
mod server;

// The repository: its text, its README, its formatting, lints and types.
mod lints;
mod readme;
mod tidy;

// The container files.
mod containers;

// The Python package's tests.
mod python;

// The real client and real servers, on reliable and unreliable networks; servers that violate the
// protocol.
mod bad_servers;
mod wire;

// Outcomes for observers, verifiers for subscribers.
mod published;

// The native simulator compared with the Python one; conformance tests.
mod simulators;

// The program outside its checkout; local servers that freeze.
mod installation;
mod local_servers;

// The command line: wrong usage, help, lists, Ctrl-C.
mod command_line;

// Evaluations with the shipped models: results, killed processes, faults, the report.
mod whole_loop;

// Policies other than the included one: checkpoints and policy servers.
mod any_policy;
mod policy_servers;

// The page of a run in a browser.
mod report_page;

// Small checkpoints compared with the packages of OpenVLA.
mod reference;

// The time of decisions.
mod bench;

// The agent as a policy server, and the peers' own programs.
mod serve_policy;

// A new verifier during a run.
mod hot_swap;
