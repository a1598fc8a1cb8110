//! The zenoh configuration of both sides: local to this machine unless configured otherwise, with
//! limits on messages.

use std::fmt::Display;

/// How long a slow reader may block a message before its link is closed.
const CONGESTION_MICROSECONDS: u64 = 60_000_000;
/// Upper bound of what zenoh adds to a body.
const ENVELOPE_BYTES: usize = 65_536;

/// Entries of zenoh's configuration as key and JSON value. `client_wait_ms` is how long a client
/// waits for its router or server. Bodies larger than `message_bytes_max` are dropped on arrival.
pub fn settings(
    connect: &[String],
    listen: &[String],
    multicast: bool,
    client_wait_ms: u32,
    message_bytes_max: usize,
) -> Vec<(&'static str, String)> {
    // A router forwards between clients but not between peers, because it assumes that peers are
    // linked to each other. A program with one endpoint to connect to and none to listen on is
    // therefore a client.
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
    // Without this entry zenoh listens on a free port of every interface, which peers find by
    // multicast.
    if !listen.is_empty() || !multicast {
        entries.push(("listen/endpoints", json(listen)));
    }
    entries
}

/// zenoh's error message without source locations, which are paths on the machine that built the
/// program.
pub fn in_words(error: impl Display) -> String {
    let text = error.to_string();
    let (mut words, mut rest) = (String::new(), text.as_str());
    // Form of a message: ERROR at FILE.rs:LINE. - Caused by ...
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
