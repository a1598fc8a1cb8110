//! Mutated frames: no panic, a clear reason, and the server goes on. The variable
//! `REVER_FUZZ_FRAMES`, read when the tests are compiled, is the number of frames of a long run.

use super::super::openpi::OpenpiClient;
use super::super::session::Session;
use super::super::vla_eval::{Outcome, VlaEvalClient};
use super::super::{MESSAGE_BYTES_MAX, act};
use super::*;
use crate::codec::tests::all_golden;
use crate::codec::tests::hostile::{Random, mutate};

/// Frames at the decoders, unless the variable says otherwise.
const FRAMES: usize = 4_000;
/// One in so many frames is also sent over a socket.
const SOCKETS: usize = 40;

fn frames() -> usize {
    let number = option_env!("REVER_FUZZ_FRAMES");
    number.map_or(FRAMES, |number| number.parse().expect("REVER_FUZZ_FRAMES is a number"))
}

fn seeds() -> Vec<Vec<u8>> {
    ["openpi_observation", "vla_eval_", "act_request"]
        .iter()
        .flat_map(|start| all_golden(start, ""))
        .map(|(_, frame)| frame)
        .collect()
}

#[tokio::test]
async fn mutated_frames_at_the_decoders_are_answered_or_refused() {
    let agent = agent(1, Strategy::Sample, 1);
    let (seeds, mut random) = (seeds(), Random(1));
    let (mut answered, mut refused) = (0, 0);
    for _ in 0..frames() {
        let [seed, other] = [0; 2].map(|_| random.below(seeds.len()));
        let frame = mutate(&seeds[seed], &seeds[other], &mut random);
        let mut openpi = OpenpiClient::new(Session::new(Arc::clone(&agent)));
        let mut vla_eval = VlaEvalClient::new(Session::new(Arc::clone(&agent)));
        let results = [
            openpi.answer(&frame).await.is_ok(),
            match vla_eval.answer(&frame, false).await.expect("replies can be encoded") {
                Outcome::Reply(_) | Outcome::Silence => true,
                Outcome::Refuse(_, reason) => {
                    assert!(!reason.is_empty());
                    false
                }
            },
            act::act(&agent, &frame).await.is_ok(),
        ];
        answered += results.iter().filter(|is_ok| **is_ok).count();
        refused += results.iter().filter(|is_ok| !**is_ok).count();
    }
    assert!(answered > 0 && refused > answered / 10, "{answered} answered, {refused} refused");
}

#[tokio::test]
async fn mutated_frames_over_sockets_leave_the_server_usable() {
    let server = Server::start(1).await;
    let (seeds, mut random) = (seeds(), Random(2));
    for _ in 0..frames() / SOCKETS {
        let [seed, other] = [0; 2].map(|_| random.below(seeds.len()));
        let frame = mutate(&seeds[seed], &seeds[other], &mut random);
        let mut client = server.connect().await;
        client.socket.send(Message::binary(frame)).await.expect("sent");
        // A message of vla-eval may have no answer; then the server waits for the next frame.
        client.socket.close(None).await.expect("closed");
        while let Some(Ok(_)) = timeout(WAIT, client.socket.next()).await.expect("in time") {}
    }
    let mut client = server.connect().await;
    client.receive_binary().await;
}

#[tokio::test]
async fn a_frame_over_the_limit_is_refused_before_it_is_received() {
    let server = Server::start(1).await;
    let mut client = server.connect().await;
    client.receive_binary().await;
    // The head of a frame that announces one byte too many, and no bytes.
    let mut head = vec![0x82, 0x80 | 127];
    head.extend((MESSAGE_BYTES_MAX as u64 + 1).to_be_bytes());
    head.extend([0; 4]);
    tokio::io::AsyncWriteExt::write_all(client.socket.get_mut(), &head).await.expect("sent");
    let (code, reason) = client.closed().await;
    assert_eq!(code, 1009);
    assert!(reason.contains("too long") || reason.contains("Space limit"), "{reason}");
}
