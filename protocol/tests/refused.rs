//! Encodings that must be refused, with the expected reasons. `golden/refused/` holds them for the
//! Python tests.

use protocol::{Description, Message, Open, PROTOCOL_VERSION, Reply, Request, decode, encode};
use serde_json::{Map, Value, json};

use crate::{examples, golden, tiles};

/// A message that must be refused: its name, its type, its bytes, and a text that the refusal must
/// contain.
pub struct Case {
    name: &'static str,
    message: &'static str,
    bytes: Vec<u8>,
    words: String,
}

pub fn case(name: &'static str, message: &'static str, bytes: Vec<u8>, words: &str) -> Case {
    Case { name, message, bytes, words: words.to_owned() }
}

/// The bytes of an example with its first `from` replaced by `to`.
pub fn changed(mut bytes: Vec<u8>, from: &[u8], to: &[u8]) -> Vec<u8> {
    let start = bytes
        .windows(from.len())
        .position(|window| window == from)
        .expect("the example contains it");
    bytes.splice(start..start + from.len(), to.iter().copied());
    bytes
}

pub fn float(value: f32) -> Vec<u8> {
    [&[0xca], &value.to_be_bytes()[..]].concat()
}

fn valid<M: Message>(message: &M) -> Vec<u8> {
    encode(message).expect("examples are valid")
}

pub fn step() -> Vec<u8> {
    valid(&examples::requests()[2].1)
}

fn reset() -> Vec<u8> {
    valid(&examples::requests()[0].1)
}

pub fn save() -> Vec<u8> {
    valid(&examples::requests()[3].1)
}

pub fn stepped() -> Vec<u8> {
    valid(&examples::replies()[1].1)
}

fn cases() -> Vec<Case> {
    let cases = [
        structure_cases(),
        field_cases(),
        length_cases(),
        number_cases(),
        peer_cases(),
        tiles::cases(),
    ];
    cases.into_iter().flatten().collect()
}

fn structure_cases() -> Vec<Case> {
    let mut nested = vec![0x91; 9];
    nested.push(0xc0);
    let double = [&[0xcb], &0.1f64.to_be_bytes()[..]].concat();
    vec![
        case("empty", "request", Vec::new(), "request cannot be read"),
        case("cut", "request", step()[..20].to_vec(), "request cannot be read"),
        case("trailing", "request", [save(), vec![0xc0]].concat(), "got 1 more bytes"),
        case("nested", "request", nested, "request cannot be read"),
        case("elements", "request", vec![0xdd, 0x7f, 0xff, 0xff, 0xff], "request cannot be read"),
        case(
            "text_length",
            "request",
            vec![0xdb, 0x7f, 0xff, 0xff, 0xff],
            "request cannot be read",
        ),
        case("number_key", "request", vec![0x81, 0x01, 0x80], "request cannot be read"),
        case("extension", "request", vec![0xd4, 0x01, 0x00], "request cannot be read"),
        case("reserved", "request", vec![0xc1], "request cannot be read"),
        case("double", "request", changed(step(), &float(0.25), &double), "request cannot be read"),
        case(
            "negative",
            "request",
            changed(save(), &[0x03], &[0xd0, 0x80]),
            "invalid value: integer `-128`, expected u64",
        ),
        case("too_large", "request", vec![0xc0; 1025], "request has 1025 bytes, limit 1024"),
    ]
}

fn field_cases() -> Vec<Case> {
    let twice = changed(save(), b"\xa4slot", b"\xa8sequence");
    let no_layout = changed(changed(reset(), b"\xa6layout\x17", b""), b"\x85\xa8", b"\x84\xa8");
    vec![
        case(
            "unknown_message",
            "request",
            changed(save(), b"Save", b"Send"),
            "unknown variant `Send`",
        ),
        case(
            "unknown_field",
            "request",
            changed(save(), b"slot", b"slit"),
            "unknown field `slit`, expected `sequence` or `slot`",
        ),
        case(
            "missing_field",
            "request",
            vec![0x81, 0xa4, b'S', b'a', b'v', b'e', 0x80],
            "missing field `sequence`",
        ),
        case("missing_optional", "request", no_layout, "missing field `layout`"),
        case("field_twice", "request", twice, "duplicate field `sequence`"),
        case("not_a_map", "request", vec![0xc0], "request cannot be read"),
        case(
            "text_for_number",
            "request",
            changed(save(), b"\x03", b"\xa1\x33"),
            "request cannot be read",
        ),
        case(
            "boolean_for_number",
            "request",
            changed(save(), b"\x03", b"\xc3"),
            "request cannot be read",
        ),
        case(
            "integer_for_float",
            "request",
            changed(step(), &float(0.25), &[0x00]),
            "request cannot be read",
        ),
    ]
}

fn length_cases() -> Vec<Case> {
    let seven: Vec<u8> = [0.015625, -0.0078125, 0.0, 0.0, 0.0, 0.25, -1.0].map(float).concat();
    let seven = [&[0x97], &seven[..]].concat();
    let none = changed(step(), &seven, &[0x90]);
    let many = [&[0xdc, 0, 129], &float(0.0).repeat(129)[..]].concat();
    let many = changed(step(), &seven, &many);
    vec![
        case(
            "no_values",
            "request",
            none,
            "request is invalid: action: expected 1 to 128 numbers, got 0",
        ),
        case(
            "many_values",
            "request",
            many,
            "request is invalid: action: expected 1 to 128 numbers, got 129",
        ),
        case(
            "text_not_utf8",
            "request",
            changed(reset(), b"spoon", b"sp\xff\xffn"),
            "request cannot be read",
        ),
        case(
            "number_for_boolean",
            "reply",
            changed(stepped(), b"truncated\xc3", b"truncated\x01"),
            "reply cannot be read",
        ),
    ]
}

fn number_cases() -> Vec<Case> {
    let number = |value| changed(step(), &float(0.25), &float(value));
    let far = changed(reset(), b"seed\x07", b"seed\xcf\x00\x20\x00\x00\x00\x00\x00\x00");
    let nothing = changed(reset(), b"\xa7default", b"\xa0");
    vec![
        case(
            "nan",
            "request",
            number(f32::NAN),
            "request is invalid: action: expected finite numbers, got nan at index 5",
        ),
        case(
            "infinite",
            "request",
            number(f32::INFINITY),
            "request is invalid: action: expected finite numbers, got inf at index 5",
        ),
        case(
            "minus_infinite",
            "request",
            number(f32::NEG_INFINITY),
            "request is invalid: action: expected finite numbers, got -inf at index 5",
        ),
        case(
            "sequence_zero",
            "request",
            changed(save(), b"\x03", b"\x00"),
            "request is invalid: sequence: expected 1 to 9007199254740991, got 0",
        ),
        case(
            "seed",
            "request",
            far,
            "request is invalid: seed: expected 0 to 9007199254740991, got 9007199254740992",
        ),
        case(
            "slot",
            "request",
            changed(save(), b"slot\x00", b"slot\x10"),
            "request is invalid: slot: expected 0 to 15, got 16",
        ),
        case(
            "empty_name",
            "request",
            nothing,
            "request is invalid: variant: expected 1 to 128 bytes, got 0",
        ),
        case(
            "control_character",
            "request",
            changed(reset(), b"\xa7default", b"\xa7def\x1b[2J"),
            "request is invalid: variant: expected no control characters, got U+001B",
        ),
    ]
}

fn peer_cases() -> Vec<Case> {
    let mut future = valid(&Open { protocol: PROTOCOL_VERSION, ..examples::open() });
    future = changed(future, b"protocol\x03", b"protocol\x04");
    let other_fields = changed(future.clone(), b"holder", b"owners");
    let pixels = examples::observation().image.pixels;
    let short = changed(
        stepped(),
        &[&[0xc4, 18], &pixels[..]].concat(),
        &[&[0xc4, 17], &pixels[..17]].concat(),
    );
    let described = valid(&examples::description());
    let high_at = |value: f32| [b"\xa4high", &float(value)[..]].concat();
    let low_at = |value: f32| [b"\xa3low", &float(value)[..]].concat();
    vec![
        case(
            "bounds_crossed",
            "description",
            changed(described.clone(), &low_at(-0.5), &low_at(1.0)),
            "description is invalid: dimension x: expected low <= high, got 1 and 0.5",
        ),
        case(
            "bounds_not_whole",
            "description",
            changed(described.clone(), &high_at(1.0), &high_at(0.5)),
            "description is invalid: dimension gripper: expected whole bounds, for it is discrete",
        ),
        case(
            "bounds_missing",
            "description",
            changed(described.clone(), &high_at(1.0), b"\xa4high\xc0"),
            "description is invalid: dimension gripper: expected whole bounds, for it is discrete",
        ),
        case(
            "control_hz",
            "description",
            changed(
                described.clone(),
                &[b"control_hz", &float(5.0)[..]].concat(),
                &[b"control_hz", &float(0.0)[..]].concat(),
            ),
            "description is invalid: control_hz: expected a number above 0, got 0",
        ),
        case("protocol", "open", future, "open is invalid: expected protocol 3, got protocol 4"),
        case(
            "protocol_and_fields",
            "open",
            other_fields,
            "open is invalid: expected protocol 3, got protocol 4",
        ),
        case(
            "image_bytes",
            "reply",
            short,
            "reply is invalid: image: expected 18 bytes for 2 x 3 pixels, got 17",
        ),
        case(
            "image_side",
            "reply",
            changed(stepped(), b"height\x02", b"height\x00"),
            "reply is invalid: image height: expected 1 to 1024, got 0",
        ),
        case(
            "reply_zero",
            "reply",
            changed(stepped(), b"sequence\x02", b"sequence\x00"),
            "reply is invalid: sequence: expected 1 to 9007199254740991, got 0",
        ),
    ]
}

fn refusal(case: &Case) -> String {
    let error = match case.message {
        "request" => decode::<Request>(&case.bytes).map(drop),
        "reply" => decode::<Reply>(&case.bytes).map(drop),
        "open" => decode::<Open>(&case.bytes).map(drop),
        "description" => decode::<Description>(&case.bytes).map(drop),
        other => panic!("no case decodes {other}"),
    };
    error.expect_err(case.name).to_string()
}

#[test]
fn malformed_bytes_are_refused_with_a_reason() {
    for case in cases() {
        let refusal = refusal(&case);
        assert!(
            refusal.contains(&case.words),
            "{}: expected {:?}, got {refusal:?}",
            case.name,
            case.words
        );
    }
}

#[test]
fn the_refused_bytes_are_kept_for_the_other_language() {
    let folder = golden::folder().join("refused");
    let index =
        Map::from_iter(cases().iter().map(|case| {
            (case.name.to_owned(), json!({"message": case.message, "words": case.words}))
        }));
    let text =
        format!("{}\n", serde_json::to_string_pretty(&Value::Object(index)).expect("plain JSON"));
    if golden::updating() {
        std::fs::create_dir_all(&folder).expect("golden/ can be written");
        std::fs::write(folder.join("index.json"), &text).expect("golden/ can be written");
        for case in cases() {
            std::fs::write(folder.join(case.name).with_extension("msgpack"), &case.bytes)
                .expect("golden/ can be written");
        }
    }
    assert_eq!(
        std::fs::read_to_string(folder.join("index.json")).expect("golden/ is complete"),
        text
    );
    for case in cases() {
        let bytes = std::fs::read(folder.join(case.name).with_extension("msgpack"))
            .expect("golden/ is complete");
        assert_eq!(bytes, case.bytes, "{}", case.name);
    }
}

#[test]
fn an_invalid_message_is_not_written() {
    let error = encode(&Request::Step { sequence: 1, action: vec![f32::NAN; 7] }).expect_err("NaN");
    assert_eq!(
        error.to_string(),
        "request is invalid: action: expected finite numbers, got nan at index 0"
    );
    let long = Open { holder: "a".repeat(129), ..examples::open() };
    assert_eq!(
        encode(&long).expect_err("long").to_string(),
        "open is invalid: holder: expected 1 to 128 bytes, got 129"
    );
}
