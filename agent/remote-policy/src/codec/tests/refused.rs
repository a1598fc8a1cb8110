//! What the decoders refuse, and the words.

use super::super::extension::{Announcement, Answer, AnswerCandidate, Ask};
use super::super::vla_eval::Message;
use super::super::{
    Array, DEPTH_MAX, Dtype, FRAME_BYTES_MAX, ITEMS_MAX, Key, KeyForm, Value, decode, decode_image,
    encode, json_numpy, openpi,
};
use super::golden;

fn words<T: std::fmt::Debug>(result: anyhow::Result<T>) -> String {
    format!("{:#}", result.expect_err("refused"))
}

fn array(dtype: &'static str, shape: &[i128], bytes: usize) -> Value<'static> {
    Value::map([
        ("__ndarray__", Value::Bool(true)),
        ("data", Value::Bytes(vec![0; bytes].into())),
        ("dtype", Value::text(dtype)),
        ("shape", Value::List(shape.iter().map(|length| Value::Integer(*length)).collect())),
    ])
}

#[test]
fn frames_that_are_not_one_bounded_value_are_refused() {
    let deep = [vec![0x91; DEPTH_MAX + 1], vec![0xc0]].concat();
    let many = [vec![0xdd, 0, 1, 0, 0], vec![0xc0; ITEMS_MAX]].concat();
    for (frame, expected) in [
        (vec![], "frame: expected 1 more bytes, got 0"),
        (vec![0xc0, 0xc0], "frame: expected the end after byte 1, got 1 more bytes"),
        (vec![0xc1], "frame: expected no extension type, got Reserved"),
        (vec![0xd4, 1, 2], "frame: expected no extension type, got FixExt1"),
        (vec![0xc6, 0xff, 0xff, 0xff, 0xff], "frame: expected 4294967295 more bytes, got 0"),
        (
            vec![0xdd, 0xff, 0xff, 0xff, 0xff],
            "frame: expected 4294967295 more values, got 0 more bytes",
        ),
        (vec![0xdf, 0, 0, 0, 9, 0xa0], "frame: expected 9 more values, got 1 more bytes"),
        (vec![0xa1, 0xff], "frame: expected text in UTF-8, got other bytes"),
        (vec![0x81, 0x01, 0xc0], "frame: expected text or bytes as a key, got an integer"),
        (
            vec![0x82, 0xa1, b'a', 1, 0xc4, 1, b'a', 2],
            "frame: expected every key once, got \"a\" twice",
        ),
        (deep, "frame: expected at most 16 nested values, got more"),
        (many, "frame: expected at most 65536 values, got more"),
        (vec![0xc0; FRAME_BYTES_MAX + 1], "frame: expected at most 33554432 bytes, got 33554433"),
    ] {
        assert_eq!(words(decode(&frame)), expected);
    }
}

#[test]
fn arrays_need_a_plain_type_and_exactly_their_bytes() {
    let types = "array: expected a type such as \"<f4\" or \"|u1\" (booleans, integers and floats of up to 8 bytes), got";
    for dtype in
        ["|V8", "|O", "<c8", "<c16", "|S4", "<U1", "<f16", "|f4", "f4", "<f", "<i3", "", "?"]
    {
        let refusal = words(Array::from_value(&array(dtype, &[1], 8)));
        assert_eq!(refusal, format!("{types} {dtype:?}"));
    }
    for (value, expected) in [
        (array("<f4", &[2], 7), "array: expected the bytes of shape [2] and type <f4, got 7 bytes"),
        (array("<f4", &[-1], 4), "array: shape: expected an integer in range, got -1"),
        (array("<f8", &[1 << 62, 1 << 62], 0), "array: expected the bytes of shape"),
        (array("|u1", &[1; 9], 1), "array: expected at most 8 dimensions, got 9"),
        (Value::text("no"), "array: expected a number, got text"),
        (
            Value::List(vec![Value::List(vec![Value::Integer(1)]), Value::Integer(1)]),
            "array: expected lists of one depth",
        ),
        (
            Value::map([("__ndarray__", Value::Bool(true))]),
            "expected the key \"data\", got __ndarray__",
        ),
    ] {
        let refusal = words(Array::from_value(&value));
        assert!(refusal.starts_with(expected), "{refusal}");
    }
    let Value::Map(mut entries) = array("<f4", &[1], 4) else { unreachable!() };
    entries.push((Key::text("pickle"), Value::Nil));
    let refusal = words(Array::from_value(&Value::Map(entries)));
    assert_eq!(refusal, "array: expected the keys __ndarray__, data, dtype, shape, got \"pickle\"");
}

#[test]
fn actions_are_finite_and_one_or_two_dimensional() {
    let result =
        |actions: Value<'static>| words(openpi::actions_of(&Value::map([("actions", actions)])));
    let nan = Array::of_f32(vec![2], &[0.0, f32::NAN]).expect("an array").into_value(KeyForm::Text);
    for (actions, expected) in [
        (array("<f4", &[0, 7], 0), "actions: expected 1 to 1024 steps, got 0"),
        (
            array("|u1", &[2, 2, 2], 8),
            "actions: expected the shape [steps, dimensions], got [2, 2, 2]",
        ),
        (array("|u1", &[65], 65), "actions: expected 1 to 64 dimensions, got 65"),
        (nan, "actions: expected finite numbers, got NaN or infinity"),
    ] {
        assert_eq!(result(actions), expected);
    }
    let front = openpi::actions_of(&Value::map([("actions", array("<f4", &[1, 3, 2], 24))]));
    assert_eq!(front.expect("a chunk"), vec![vec![0.0; 2]; 3]);
    assert_eq!(
        words(openpi::actions_of(&Value::map([]))),
        "openpi result: expected the key \"actions\", got an empty map"
    );
}

#[test]
fn images_are_bounded_before_their_pixels_are_decoded() {
    let with = |name: &str, value: Value<'static>| {
        let frame = golden("vla_eval_observation_png.msgpack");
        let message = Message::decode(&frame).expect("a message");
        let image = message.payload.field("images").and_then(|images| images.field("primary"));
        let Value::Map(mut entries) = image.expect("an image").clone() else { unreachable!() };
        entries
            .iter_mut()
            .filter(|(key, _)| key.name == name)
            .for_each(|(_, old)| *old = value.clone());
        words(decode_image(&Value::Map(entries)))
    };
    let shape = |sides: [i128; 3]| Value::List(sides.map(Value::Integer).to_vec());
    for (refusal, expected) in [
        (with("shape", shape([2, 2, 3])), "image: cannot decode the pixels"),
        (with("shape", shape([3, 3, 3])), "image: expected 3 x 3 pixels, got 2 x 3"),
        (
            with("shape", shape([2, 3, 4])),
            "image: expected the shape [height, width, 3], got [2, 3, 4]",
        ),
        (with("shape", shape([1 << 20, 1 << 20, 3])), "image: expected sides of 1 to 2048 pixels"),
        (with("data", Value::Bytes(vec![1, 2].into())), "image: cannot decode the pixels"),
        (
            with("format", Value::text("gif")),
            "image: expected the format png, jpeg or raw, got \"gif\"",
        ),
        (
            words(decode_image(&array("<f4", &[1, 1, 3], 12))),
            "image: expected pixels of type \"|u1\", got \"<f4\"",
        ),
    ] {
        assert!(refusal.starts_with(expected), "{refusal}");
    }
}

#[test]
fn messages_need_their_four_keys() {
    let message = |entries: Vec<(&'static str, Value<'static>)>| {
        words(Message::decode(&encode(&Value::map(entries)).expect("encodes")))
    };
    let full = || {
        vec![
            ("type", Value::text("hello")),
            ("payload", Value::map([])),
            ("seq", Value::Integer(1)),
            ("timestamp", Value::Float(0.0)),
        ]
    };
    for index in 0..4 {
        let mut entries = full();
        let (name, _) = entries.remove(index);
        assert_eq!(message(entries), format!("vla-eval message: expected the key {name:?}"));
    }
    let mut entries = full();
    entries[0].1 = Value::text("goodbye");
    assert!(message(entries).contains("type: expected one of hello, observation"));
    assert_eq!(words(Message::decode(&[0x90])), "vla-eval message: expected a map");
}

#[test]
fn bodies_are_bounded_json() {
    let deep = format!("{}{}", "[".repeat(17), "]".repeat(17));
    let many = format!("[{}0]", "0,".repeat(ITEMS_MAX));
    for (body, expected) in [
        ("", "body: expected JSON"),
        ("1 2", "body: expected one JSON value"),
        (&*deep, "body: expected JSON: expected at most 16 nested values"),
        (&*many, "body: expected JSON: expected at most 65536 values"),
        (r#"{"a":1,"a":2}"#, "body: expected JSON: expected every key once"),
    ] {
        let refusal = words(json_numpy::decode(body.as_bytes()));
        assert!(refusal.starts_with(expected), "{refusal}");
    }
    let no_base64 =
        json_numpy::decode(br#"{"__numpy__":"*","dtype":"<f4","shape":[1]}"#).expect("JSON");
    assert!(words(json_numpy::array(&no_base64.value)).starts_with("array: expected base64"));
}

#[test]
fn the_optional_fields_are_read_back_and_checked() {
    for keys in [KeyForm::Text, KeyForm::Bytes] {
        let announcement = Announcement {
            candidates_max: 5,
            digest: Some("477a".to_owned()),
            is_greedy: true,
            image_size: Some((224, 128)),
            hidden_size: Some(64),
            confidence_size: Some(16),
            action_scale: Some(vec![0.5; 7]),
        };
        let ask = Ask {
            candidates: Some(5),
            temperature: Some(0.5),
            seed: Some(u64::MAX),
            episode: Some("stack-3".to_owned()),
        };
        let candidate = AnswerCandidate {
            actions: vec![vec![0.5, -0.5]; 2],
            reasoning: Some("TASK: stack".to_owned()),
            malformed: None,
            score: Some(0.25),
            tokens: vec![1, u32::MAX],
            action_tokens: vec![3; 4],
            log_probability: Some(-2.5),
            log_probabilities: vec![-1.0, -1.5],
            confidence: vec![-0.5],
            hidden: vec![0.25; 3],
        };
        let malformed =
            AnswerCandidate { malformed: Some("cut".to_owned()), ..AnswerCandidate::default() };
        let answer = Answer {
            chosen: Some(0),
            candidates: vec![candidate, malformed],
            digest: Some("477a".to_owned()),
        };
        let frame =
            |value: Value<'static>| encode(&Value::map([("rever", value)])).expect("encodes");
        let announced = frame(announcement.value(keys).expect("encodes"));
        let read = Announcement::read(&decode(&announced).expect("decodes")).expect("fields");
        assert_eq!(read, Some(announcement));
        let asked = frame(ask.value());
        assert_eq!(Ask::read(&decode(&asked).expect("decodes")).expect("fields"), Some(ask));
        let answered = frame(answer.value(keys).expect("encodes"));
        assert_eq!(
            Answer::read(&decode(&answered).expect("decodes")).expect("fields"),
            Some(answer)
        );
    }
    assert_eq!(Answer::read(&Value::map([])).expect("no fields"), None);
}

#[test]
fn wrong_optional_fields_are_refused() {
    let within =
        |fields: Vec<(&'static str, Value<'static>)>| Value::map([("rever", Value::map(fields))]);
    let version = words(Announcement::read(&within(vec![("version", Value::Integer(2))])));
    assert_eq!(version, "rever: version: expected 1, got 2");
    let none = words(Ask::read(&within(vec![("candidates", Value::Integer(0))])));
    assert_eq!(none, "rever: candidates: expected 1 to 256, got 0");
    let cold = words(Ask::read(&within(vec![("temperature", Value::Float(-1.0))])));
    assert!(cold.starts_with("rever: temperature: expected 0 or more"), "{cold}");
    let chosen = words(Answer::read(&within(vec![("chosen", Value::Integer(1))])));
    assert!(
        chosen.starts_with("rever: chosen: expected the index of one of 0 candidates"),
        "{chosen}"
    );
    let neither = within(vec![("candidates", Value::List(vec![Value::map([])]))]);
    assert_eq!(
        words(Answer::read(&neither)),
        "rever: candidate 0: expected either actions or the reason why it is malformed"
    );
    let floats = Value::map([
        ("actions", Value::List(vec![Value::Integer(1)])),
        ("tokens", Array::of_f32(vec![1], &[1.0]).expect("an array").into_value(KeyForm::Text)),
    ]);
    let floats = within(vec![("candidates", Value::List(vec![floats]))]);
    assert_eq!(
        words(Answer::read(&floats)),
        "rever: candidate 0: tokens: array: expected integers, got type <f4"
    );
    assert!(Dtype::parse("float32").is_ok());
}
