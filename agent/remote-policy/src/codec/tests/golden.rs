//! The peers' frames are read, and our frames have the peers' bytes.

use decision::Image;

use super::super::vla_eval::{Kind, Message};
use super::super::{
    ImageForm, Value, decode_image, encode, image_value, json_numpy, openpi, vla_eval,
};
use super::{CHUNK, PIXELS, STATE, all_golden, golden, state};
use crate::codec::Array;

fn image() -> Image {
    Image { height: 2, width: 3, pixels: PIXELS.to_vec().into() }
}

#[test]
fn an_openpi_observation_has_the_bytes_of_the_client_package() {
    let image = image();
    let observation = Value::map([
        (
            "observation/image",
            image_value(&image, ImageForm::Array(openpi::KEYS)).expect("an image"),
        ),
        ("observation/state", state(openpi::KEYS)),
        ("prompt", Value::text("stack the cubes")),
    ]);
    let expected = golden("openpi_observation.msgpack");
    assert_eq!(encode(&observation).expect("encodes"), expected);
    let read = openpi::map(&expected).expect("decodes");
    assert_eq!(read, observation);
    assert_eq!(
        decode_image(read.field("observation/image").expect("a key")).expect("an image"),
        image
    );
}

#[test]
fn openpi_results_of_every_number_type_are_read() {
    for (name, length) in
        [("openpi_result", 2), ("openpi_result_half", 1), ("openpi_result_big_endian", 2)]
    {
        let frame = golden(&format!("{name}.msgpack"));
        let result = openpi::map(&frame).expect(name);
        assert_eq!(openpi::actions_of(&result).expect(name), CHUNK[..length], "{name}");
    }
    let frame = golden("openpi_result.msgpack");
    let result = openpi::map(&frame).expect("decodes");
    let timing = result.field("policy_timing").and_then(|timing| timing.field("infer_ms"));
    let scalar = Array::from_value(timing.expect("a field")).expect("a NumPy scalar");
    assert_eq!((scalar.shape.clone(), scalar.to_f32()), (vec![], vec![12.5]));
    assert_eq!(openpi::map(&golden("openpi_metadata.msgpack")).expect("a map"), Value::Map(vec![]));
}

#[test]
fn vla_eval_observations_are_read_in_every_form_of_the_image() {
    let image = image();
    for form in ["png", "jpeg", "array", "raw"] {
        let frame = golden(&format!("vla_eval_observation_{form}.msgpack"));
        let message = Message::decode(&frame).expect(form);
        assert_eq!((message.kind, message.sequence), (Kind::Observation, 3));
        assert_eq!(message.timestamp, 1_700_000_000.25);
        let primary = message.payload.field("images").and_then(|images| images.field("primary"));
        let seen = decode_image(primary.expect("a camera")).expect(form);
        let worst = seen.pixels.iter().zip(&PIXELS).map(|(a, b)| a.abs_diff(*b)).max();
        // JPEG is lossy, and more so for so small an image.
        assert!(worst <= Some(if form == "jpeg" { 40 } else { 0 }), "{form}: {worst:?}");
        assert_eq!((seen.height, seen.width), (2, 3));
        let states = Array::from_value(message.payload.field("states").expect("a key"));
        assert_eq!(states.expect("an array").to_f32(), STATE);
    }
    for (name, form) in [("array", ImageForm::Array(vla_eval::KEYS)), ("raw", ImageForm::Raw)] {
        let primary = image_value(&image, form).expect("an image");
        let payload = Value::map([
            ("images", Value::map([("primary", primary)])),
            ("task_description", Value::text("stack the cubes")),
            ("states", state(vla_eval::KEYS)),
        ]);
        let (kind, timestamp) = (Kind::Observation, 1_700_000_000.25);
        let message = Message { kind, payload, sequence: 3, timestamp };
        let expected = golden(&format!("vla_eval_observation_{name}.msgpack"));
        assert_eq!(message.encode().expect("encodes"), expected, "{name}");
    }
}

#[test]
fn every_vla_eval_message_is_read_and_written_back() {
    for (name, frame) in all_golden("vla_eval_", ".msgpack") {
        let message = Message::decode(&frame).unwrap_or_else(|error| panic!("{name}: {error:#}"));
        assert_eq!(message.encode().expect("encodes"), frame, "{name}");
    }
    let read = |name: &str| golden(&format!("vla_eval_{name}.msgpack"));
    let action = read("action");
    let action = Message::decode(&action).expect("a message");
    assert_eq!(vla_eval::actions_of(&action.payload).expect("actions"), CHUNK[..1]);
    let error = read("error");
    let error = Message::decode(&error).expect("a message");
    assert_eq!(vla_eval::error_of(&error.payload), "observation_failed: KeyError: 'images'");
    for name in ["hello_client", "hello_server"] {
        vla_eval::check_hello(&Message::decode(&read(name)).expect(name).payload).expect(name);
    }
}

#[test]
fn openvla_bodies_are_read_encoded_once_and_twice() {
    for name in ["act_request", "act_request_encoded"] {
        let body = json_numpy::decode(&golden(&format!("{name}.json"))).expect(name);
        assert_eq!(body.is_encoded, name.ends_with("encoded"));
        let pixels =
            json_numpy::array(body.value.field("image").expect("a key")).expect("an array");
        assert_eq!((pixels.shape.clone(), &*pixels.bytes), (vec![2, 3, 3], &PIXELS[..]));
        assert_eq!(
            body.value.field("instruction").and_then(|text| text.as_text()).expect("text"),
            "stack the cubes"
        );
    }
    for name in ["act_reply", "act_reply_encoded", "act_reply_list"] {
        let body = json_numpy::decode(&golden(&format!("{name}.json"))).expect(name);
        assert_eq!(json_numpy::array(&body.value).expect(name).to_f32(), CHUNK[0], "{name}");
    }
    let error = json_numpy::decode(&golden("act_error.json")).expect("JSON");
    assert_eq!(error.value, Value::text("error"));
}

#[test]
fn our_openvla_request_is_read_back() {
    let image = image();
    let pixels =
        Array::new(crate::codec::Dtype::U8, vec![2, 3, 3], &*image.pixels).expect("an array");
    let request = Value::map([
        ("image", json_numpy::array_value(&pixels)),
        ("instruction", Value::text("stack the cubes")),
        ("unnorm_key", Value::text("b")),
    ]);
    let body = json_numpy::encode(&request).expect("encodes");
    let theirs = json_numpy::decode(&golden("act_request.json")).expect("decodes");
    for (text, is_encoded) in [(json_numpy::encode_twice(&body), true), (body, false)] {
        let ours = json_numpy::decode(text.as_bytes()).expect("decodes");
        assert_eq!(ours.is_encoded, is_encoded);
        for key in ["image", "instruction", "unnorm_key"] {
            assert_eq!(ours.value.field(key).expect(key), theirs.value.field(key).expect(key));
        }
    }
}
