//! The encoding of each example equals its golden file and decodes to the example.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::path::{Path, PathBuf};

use protocol::{Message, decode, encode};

use crate::examples;

pub fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden")
}

/// The tests write files only with this explicit switch.
pub fn updating() -> bool {
    std::env::var_os("REVER_UPDATE_GOLDEN").is_some_and(|value| value == "1")
}

fn check<M: Message + Debug + PartialEq>(name: &str, message: &M) -> String {
    let file = folder().join(name).with_extension("msgpack");
    let bytes = encode(message).expect("examples are valid");
    if updating() {
        std::fs::write(&file, &bytes).expect("golden/ can be written");
    }
    let golden = std::fs::read(&file).expect("every example has a golden file");
    assert_eq!(golden, bytes, "{name}: encoded bytes differ from the golden file");
    assert_eq!(&decode::<M>(&golden).expect(name), message, "{name}");
    for length in 0..golden.len() {
        assert!(decode::<M>(&golden[..length]).is_err(), "{name}: accepted {length} bytes of it");
    }
    let mut longer = golden;
    longer.push(0xc0);
    assert!(decode::<M>(&longer).is_err(), "{name}: accepted an extra byte");
    file.file_name().expect("a file").to_string_lossy().into_owned()
}

#[test]
fn every_message_has_its_golden_bytes() {
    let mut files = BTreeSet::new();
    files.insert(check("description", &examples::description()));
    files.insert(check("heartbeat", &examples::heartbeat()));
    files.insert(check("open", &examples::open()));
    files.extend(examples::openings().iter().map(|(name, opening)| check(name, opening)));
    files.extend(examples::requests().iter().map(|(name, request)| check(name, request)));
    files.extend(examples::replies().iter().map(|(name, reply)| check(name, reply)));
    files.insert(check("outcome", &examples::outcome()));
    files.insert(check("verifier_update", &examples::verifier_update()));
    let present: BTreeSet<String> = std::fs::read_dir(folder())
        .expect("golden/ can be listed")
        .map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned())
        .filter(|name| name.ends_with(".msgpack"))
        .collect();
    assert_eq!(present, files, "golden files without an example");
}

#[test]
fn flipped_bytes_are_refused_or_read_as_a_valid_message() {
    for (name, request) in examples::requests() {
        let golden = encode(&request).expect("examples are valid");
        for position in 0..golden.len() {
            for value in 0..=u8::MAX {
                let mut bytes = golden.clone();
                bytes[position] = value;
                if let Ok(read) = decode::<protocol::Request>(&bytes) {
                    let again = encode(&read).expect("what is read is valid");
                    assert_eq!(decode(&again), Ok(read), "{name} byte {position} as {value:#04x}");
                }
            }
        }
    }
}

#[test]
fn lists_and_texts_of_every_header_are_read() {
    for (tasks, letters) in [(15, 31), (16, 32), (255, 255), (256, 256), (4096, 20)] {
        let mut description = examples::description();
        description.tasks = vec![description.tasks[0].clone(); tasks];
        for task in &mut description.tasks {
            task.instruction = "a".repeat(letters);
        }
        match encode(&description) {
            Ok(bytes) => assert_eq!(decode(&bytes), Ok(description), "{tasks} {letters}"),
            Err(error) => {
                assert_eq!((tasks, error.to_string().contains("limit 262144")), (4096, true));
            }
        }
    }
}
