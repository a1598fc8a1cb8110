//! Encodings that our encoder does not produce and that every decoder must accept.
//! `golden/other_forms/` holds them for the Python tests.

use std::fmt::Debug;

use protocol::{Message, decode};
use serde_json::{Map, Value, json};

use crate::refused::{changed, float, save, step, stepped};
use crate::{examples, golden};

/// Each encoding with the name of the example that it represents.
fn forms() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let action = [0.015625, -0.0078125, 0.0, 0.0, 0.0, 0.25, -1.0].map(float).concat();
    let pixels = examples::observation().image.pixels;
    vec![
        (
            "integer_longer",
            "request_save",
            changed(save(), b"sequence\x03", b"sequence\xcd\x00\x03"),
        ),
        ("integer_signed", "request_save", changed(save(), b"sequence\x03", b"sequence\xd0\x03")),
        ("text_longer", "request_save", changed(save(), b"\xa4slot", b"\xda\x00\x04slot")),
        ("map_longer", "request_save", changed(save(), b"Save\x82", b"Save\xde\x00\x02")),
        ("map_reordered", "request_save", b"\x81\xa4Save\x82\xa4slot\x00\xa8sequence\x03".to_vec()),
        (
            "array_longer",
            "request_step",
            changed(
                step(),
                &[&[0x97], &action[..]].concat(),
                &[&[0xdd, 0, 0, 0, 7], &action[..]].concat(),
            ),
        ),
        (
            "bytes_longer",
            "reply_stepped",
            changed(
                stepped(),
                &[&[0xc4, 18], &pixels[..]].concat(),
                &[&[0xc6, 0, 0, 0, 18], &pixels[..]].concat(),
            ),
        ),
    ]
}

fn check<M: Message + Debug + PartialEq>(
    name: &str,
    bytes: &[u8],
    examples: &[(&str, M)],
    of: &str,
) {
    let (_, example) = examples.iter().find(|(name, _)| *name == of).expect("an example");
    assert_eq!(decode::<M>(bytes).as_ref(), Ok(example), "{name}");
}

#[test]
fn other_forms_of_a_message_are_read_as_the_message() {
    let folder = golden::folder().join("other_forms");
    let index = Map::from_iter(forms().iter().map(|(name, of, _)| ((*name).to_owned(), json!(of))));
    let text =
        format!("{}\n", serde_json::to_string_pretty(&Value::Object(index)).expect("plain JSON"));
    if golden::updating() {
        std::fs::create_dir_all(&folder).expect("golden/ can be written");
        std::fs::write(folder.join("index.json"), &text).expect("golden/ can be written");
    }
    assert_eq!(
        std::fs::read_to_string(folder.join("index.json")).expect("golden/ is complete"),
        text
    );
    for (name, of, bytes) in forms() {
        let file = folder.join(name).with_extension("msgpack");
        if golden::updating() {
            std::fs::write(&file, &bytes).expect("golden/ can be written");
        }
        assert_eq!(std::fs::read(&file).expect("golden/ is complete"), bytes, "{name}");
        if of.starts_with("request") {
            check(name, &bytes, &examples::requests(), of);
        } else {
            check(name, &bytes, &examples::replies(), of);
        }
    }
}
