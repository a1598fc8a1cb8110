//! How both sides configure zenoh: this machine and nothing else unless told otherwise, and the limits on messages.

use std::fmt::Display;

use crate::limits::MESSAGE_BYTES_MAX;

/// A variable of the environment, from which alone zenoh takes its threads. To be set before zenoh is used.
pub const RUNTIME_VARIABLE: &str = "ZENOH_RUNTIME";
/// One pool for all that zenoh does, so that no message is handed from one thread to another between the socket and the
/// callback. Several threads, for programs whose callbacks may wait: the caches of outcomes and verifiers answer in them.
pub const RUNTIME_POOL: &str = "(acc: (handover: app), rx: (handover: app), tx: (handover: app), net: (handover: app), app: (worker_threads: 4))";
/// A pool of one thread, for programs whose callbacks only hand on: threads that share messages wake one another.
pub const RUNTIME_SINGLE: &str = "(acc: (handover: app), rx: (handover: app), tx: (handover: app), net: (handover: app), app: (worker_threads: 1))";
/// A slow reader holds a message up that long before the link is given up.
const CONGESTION_MICROSECONDS: u64 = 60_000_000;
/// A reply with its picture is three of zenoh's batches or more: all of them fit into the queue at once, where two, zenoh's
/// own choice, stop the sender until the first one is gone.
const QUEUED_BATCHES: usize = 16;
/// What zenoh adds to a body.
const ENVELOPE_BYTES: usize = 65_536;

/// Entries of zenoh's configuration as key and JSON value. `client_wait_ms`: how long a client waits for the router or
/// server that it is told to connect to.
pub fn settings(
    connect: &[String],
    listen: &[String],
    multicast: bool,
    client_wait_ms: u32,
) -> Vec<(&'static str, String)> {
    // A router forwards between its clients, not between its peers, which it takes for linked. And
    // whoever has one way out and no way in needs no more than a client does.
    let is_client = connect.len() == 1 && listen.is_empty() && !multicast;
    let mut entries = vec![
        ("mode", if is_client { "\"client\"" } else { "\"peer\"" }.to_owned()),
        ("connect/timeout_ms", format!("{{\"client\": {client_wait_ms}}}")),
        ("connect/endpoints", json(connect)),
        ("scouting/multicast/enabled", multicast.to_string()),
        ("scouting/gossip/enabled", multicast.to_string()),
        // The caches of outcomes and verifiers order their samples by time.
        ("timestamping/enabled", "true".to_owned()),
        ("transport/link/rx/max_message_size", (MESSAGE_BYTES_MAX + ENVELOPE_BYTES).to_string()),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            CONGESTION_MICROSECONDS.to_string(),
        ),
        ("transport/link/tx/queue/size/data", QUEUED_BATCHES.to_string()),
    ];
    // Left out, this is a free port on every interface: what others find by multicast.
    if !listen.is_empty() || !multicast {
        entries.push(("listen/endpoints", json(listen)));
    }
    entries
}

/// What zenoh says of an error, without the places in its sources: they are paths of the machine that built the program.
pub fn in_words(error: impl Display) -> String {
    let text = error.to_string();
    let (mut words, mut rest) = (String::new(), text.as_str());
    // ERROR at FILE.rs:LINE. - Caused by ...
    while let Some((before, after)) = rest.split_once(".rs:") {
        let line_end = after.find(|next: char| !next.is_ascii_digit()).unwrap_or(after.len());
        let start = before.rfind(" at ").unwrap_or(before.len());
        words.push_str(&before[..start]);
        rest = after[line_end..].strip_prefix('.').unwrap_or(&after[line_end..]);
    }
    words + rest
}

fn json(endpoints: &[String]) -> String {
    serde_json::to_string(endpoints).expect("texts can be written as JSON")
}

#[cfg(test)]
mod tests {
    use super::in_words;

    #[test]
    fn an_error_of_zenoh_names_no_file_of_the_machine_that_built_it() {
        let check = |text, expected| assert_eq!(in_words(text), expected);
        check("Timeout!", "Timeout!");
        check(
            "no link at tcp/a:1 at /home/a b/.cargo/zenoh-1.10.2/src/net.rs:12.",
            "no link at tcp/a:1",
        );
        check(
            "lost at /x/a.rs:12. - Caused by refused at /x/b.rs:345.",
            "lost - Caused by refused",
        );
    }
}
