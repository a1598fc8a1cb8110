//! Mutated frames: no decoder panics, and what it allocates is bounded by the frame.

use std::time::{Duration, Instant};

use super::super::extension::{Announcement, Answer, AnswerCandidate, Ask};
use super::super::vla_eval::Message;
use super::super::{
    Array, KeyForm, Value, decode, decode_image, encode, json_numpy, openpi, vla_eval,
};
use super::all_golden;

/// Mutated frames in one run of the test.
const FRAMES: usize = 100_000;
/// A decoder that took time in proportion to an announced length would exceed this.
const TIME_MAX: Duration = Duration::from_secs(600);

/// A small generator of numbers: the frames are the same in every run.
pub struct Random(pub u64);

impl Random {
    /// SplitMix64 (Steele, Lea and Flood, 2014).
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut word = self.0;
        word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        word ^ (word >> 31)
    }

    pub fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }
}

/// Changes, removes, inserts or repeats bytes in one to four places.
pub fn mutate(frame: &[u8], other: &[u8], random: &mut Random) -> Vec<u8> {
    /// Markers of lengths, nesting and extension types.
    const MARKERS: [u8; 10] = [0xc1, 0xc6, 0xc9, 0xd9, 0xdb, 0xdd, 0xdf, 0xc7, 0x9f, 0x8f];
    let mut bytes = frame.to_vec();
    for _ in 0..=random.below(4) {
        let at = random.below(bytes.len() + 1);
        match random.below(7) {
            0 => bytes.truncate(at),
            1 => bytes.insert(at, random.next() as u8),
            2 if at < bytes.len() => drop(bytes.remove(at)),
            3 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            4 if at < bytes.len() => bytes[at] = MARKERS[random.below(MARKERS.len())],
            5 => {
                let start = random.below(other.len());
                bytes.splice(at..at, other[start..].iter().take(random.below(40)).copied());
            }
            _ => bytes.splice(at..at, [0xff; 4]).for_each(drop),
        }
    }
    bytes
}

/// Everything that a client or a server does with a frame.
fn use_frame(frame: &[u8]) -> usize {
    let mut accepted = 0;
    if let Ok(value) = decode(frame) {
        accepted += 1;
        use_value(&value);
    }
    if let Ok(message) = Message::decode(frame) {
        let _ = vla_eval::check_hello(&message.payload);
        let _ = vla_eval::actions_of(&message.payload);
        let _ = vla_eval::error_of(&message.payload);
        use_value(&message.payload);
        let images = message.payload.get("images").and_then(|images| images.get("primary"));
        let _ = images.map(decode_image);
        let _ = message.encode();
    }
    accepted
}

fn use_value(value: &Value<'_>) {
    let _ = openpi::actions_of(value);
    let _ = Announcement::read(value);
    let _ = Ask::read(value);
    let _ = Answer::read(value);
    for (_, field) in value.entries().unwrap_or_default() {
        let _ = Array::from_value(field).map(|array| array.to_f32().len());
        let _ = decode_image(field);
    }
    let _ = encode(value);
}

fn optional_fields() -> Vec<Vec<u8>> {
    let candidate = AnswerCandidate {
        actions: vec![vec![0.5; 7]; 2],
        reasoning: Some("TASK: stack".to_owned()),
        tokens: vec![1, 2, 3],
        log_probabilities: vec![-1.0; 3],
        confidence: vec![-0.5; 16],
        hidden: vec![0.25; 8],
        ..AnswerCandidate::default()
    };
    let answer = Answer { chosen: Some(0), candidates: vec![candidate; 2], digest: None };
    let announcement = Announcement { candidates_max: 5, ..Announcement::default() };
    let ask = Ask { candidates: Some(5), temperature: Some(1.0), seed: Some(1), episode: None };
    let fields = [
        answer.value(KeyForm::Bytes).expect("encodes"),
        announcement.value(KeyForm::Text).expect("encodes"),
        ask.value(),
    ];
    let frame = |fields: Value<'static>| encode(&Value::map([("rever", fields)])).expect("encodes");
    fields.map(frame).to_vec()
}

#[test]
fn no_decoder_panics_on_mutated_frames() {
    let mut frames: Vec<Vec<u8>> =
        all_golden("", ".msgpack").into_iter().map(|(_, frame)| frame).collect();
    frames.extend(optional_fields());
    let bodies: Vec<Vec<u8>> =
        all_golden("act_", ".json").into_iter().map(|(_, body)| body).collect();
    let (mut random, started, mut accepted) = (Random(20), Instant::now(), 0);
    for index in 0..FRAMES {
        let is_json = index % 5 == 0;
        let pool = if is_json { &bodies } else { &frames };
        let (frame, other) = (&pool[random.below(pool.len())], &pool[random.below(pool.len())]);
        let mutated = mutate(frame, other, &mut random);
        if is_json {
            let Ok(body) = json_numpy::decode(&mutated) else { continue };
            accepted += 1;
            let _ = json_numpy::array(&body.value).map(|array| array.to_f32().len());
            let _ = body.value.get("image").map(json_numpy::array);
        } else {
            accepted += use_frame(&mutated);
        }
    }
    let elapsed = started.elapsed();
    assert!(elapsed < TIME_MAX, "{FRAMES} frames took {elapsed:?}");
    // Some mutations keep a frame valid, so that code behind the first check is reached, too.
    assert!((FRAMES / 100..FRAMES).contains(&accepted), "{accepted} of {FRAMES} were accepted");
}
