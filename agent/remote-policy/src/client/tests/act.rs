//! OpenVLA's `/act` over HTTP.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::sync::mpsc;

use super::{connect, episode, motions, propose, words};
use crate::codec::json_numpy;

/// Answers every request with this status and body; sends the received bodies.
fn server(status: &'static str, body: &'static str) -> (String, mpsc::Receiver<Vec<u8>>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = format!("http://{}/act", listener.local_addr().expect("an address"));
    let (sender, received) = mpsc::channel();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.expect("a connection");
            let mut bytes = Vec::new();
            let mut buffer = [0; 65536];
            let request = loop {
                let count = stream.read(&mut buffer).expect("bytes");
                bytes.extend_from_slice(&buffer[..count]);
                let Some(head) = bytes.windows(4).position(|four| four == b"\r\n\r\n") else {
                    if count == 0 {
                        break None;
                    }
                    continue;
                };
                let text = String::from_utf8_lossy(&bytes[..head]).to_ascii_lowercase();
                let length = text
                    .split("content-length: ")
                    .nth(1)
                    .and_then(|rest| rest.split("\r\n").next());
                let length: usize = length.expect("a length").parse().expect("a number");
                if bytes.len() >= head + 4 + length {
                    break Some(bytes[head + 4..].to_vec());
                }
            };
            let Some(request) = request else { continue };
            let length = body.len();
            let answer = format!(
                "HTTP/1.1 {status}\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n{body}"
            );
            stream.write_all(answer.as_bytes()).expect("written");
            if sender.send(request).is_err() {
                return;
            }
        }
    });
    (address, received)
}

#[test]
fn every_form_of_the_answer_is_read() {
    for (name, body) in [
        ("array", include_str!("../../../golden/act_reply.json")),
        ("twice", include_str!("../../../golden/act_reply_encoded.json")),
        ("list", include_str!("../../../golden/act_reply_list.json")),
    ] {
        let (address, received) = server("200 OK", body);
        let policy = connect(&address, None).expect(name);
        let proposal = propose(&policy, &episode(), 2, 0).expect(name);
        assert_eq!(motions(&proposal), [0.5, 0.5], "{name}");
        let request = json_numpy::decode(&received.recv().expect("a request")).expect("JSON");
        let keys: Vec<&str> =
            request.value.entries().expect("a map").iter().map(|(key, _)| &*key.name).collect();
        assert_eq!(keys, ["image", "instruction"], "{name}");
        let image =
            json_numpy::array(request.value.field("image").expect("a key")).expect("an array");
        assert_eq!(image.shape, [224, 224, 3]);
    }
}

#[test]
fn failures_of_the_script_are_named() {
    for (status, body, expected) in [
        ("200 OK", "\"error\"", "the server failed: it answered \"error\"; its own log says why"),
        ("422 Unprocessable", "no image", "the server answered 422 Unprocessable Entity: no image"),
        ("200 OK", "[1, 2", "body: expected JSON"),
        ("200 OK", "[1, 2]", "actions: expected 7 dimensions, got 2"),
    ] {
        let (address, _received) = server(status, body);
        let policy = connect(&address, None).expect("a policy");
        let refusal = words(propose(&policy, &episode(), 1, 0));
        assert!(refusal.contains(expected), "{refusal}");
    }
}
