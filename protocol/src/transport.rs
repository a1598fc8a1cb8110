//! How both sides configure zenoh: this machine and nothing else unless told otherwise, and the limits on messages.

/// A slow reader holds a message up that long before the link is given up.
const CONGESTION_MICROSECONDS: u64 = 60_000_000;
/// What zenoh adds to a body.
const ENVELOPE_BYTES: usize = 65_536;

/// Entries of zenoh's configuration as key and JSON value. `client_wait_ms`: how long a client waits for the router or
/// server that it is told to connect to. `message_bytes_max`: larger bodies are dropped as they arrive.
pub fn settings(
    connect: &[String],
    listen: &[String],
    multicast: bool,
    client_wait_ms: u32,
    message_bytes_max: usize,
) -> Vec<(&'static str, String)> {
    // A router forwards between its clients, not between its peers, which it takes for linked. And
    // a program with one way out and no way in needs no more than a client does.
    let is_client = connect.len() == 1 && listen.is_empty() && !multicast;
    let mut entries = vec![
        ("mode", if is_client { "\"client\"" } else { "\"peer\"" }.to_owned()),
        ("connect/timeout_ms", format!("{{\"client\": {client_wait_ms}}}")),
        ("connect/endpoints", json(connect)),
        ("scouting/multicast/enabled", multicast.to_string()),
        ("scouting/gossip/enabled", multicast.to_string()),
        // The caches of outcomes and verifiers order their samples by time.
        ("timestamping/enabled", "true".to_owned()),
        ("transport/link/rx/max_message_size", (message_bytes_max + ENVELOPE_BYTES).to_string()),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            CONGESTION_MICROSECONDS.to_string(),
        ),
    ];
    // Left out, this is a free port on every interface: what others find by multicast.
    if !listen.is_empty() || !multicast {
        entries.push(("listen/endpoints", json(listen)));
    }
    entries
}

/// An error of zenoh without the places in its source, which are paths of the machine that built it.
pub fn cause(error: &str) -> String {
    let mut parts = error.split(" at /");
    let mut cause = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // `.../tcp.rs:61.` and what follows it.
        let place = part.split_once(".rs:").map(|(_, line)| {
            line.trim_start_matches(|letter: char| letter.is_ascii_digit()).trim_start_matches('.')
        });
        match place {
            Some(rest) => cause.push_str(rest),
            None => cause.push_str(&format!(" at /{part}")),
        }
    }
    cause
}

fn json(endpoints: &[String]) -> String {
    serde_json::to_string(endpoints).expect("texts can be written as JSON")
}
