//! A server whose frames are mutated: every answer is an action or a fault, never a panic.

use std::sync::{Arc, Mutex};

use tokio_tungstenite::tungstenite::Message;

use super::scripted::{Scripted, metadata};
use super::{connect, episode, propose};
use crate::codec::tests::golden;
use crate::codec::tests::hostile::{Random, mutate};

/// Decisions that are answered with a mutated frame.
const DECISIONS: usize = 400;

#[test]
fn mutated_answers_over_a_socket_are_actions_or_faults() {
    let frame = golden("openpi_result.msgpack");
    let random = Mutex::new(Random(7));
    let script = move |_: usize, _: &[u8]| {
        let mut random = random.lock().expect("not poisoned");
        Some(vec![Message::Binary(mutate(&frame, &frame, &mut random).into())])
    };
    let server = Scripted::start(0, metadata(), Arc::new(script));
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let (mut running, mut faults) = (episode(), 0);
    for seed in 0..DECISIONS {
        if let Err(error) = propose(&policy, &running, 1, seed as u64) {
            let error = format!("{error:#}");
            assert!(!error.contains("panicked") && error.len() < 1000, "{error}");
            faults += 1;
            running = episode();
        }
    }
    assert!(
        (DECISIONS / 10..DECISIONS).contains(&faults),
        "{faults} faults in {DECISIONS} decisions"
    );
}
