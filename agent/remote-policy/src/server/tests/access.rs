//! Keys, places, web pages and plain HTTP.

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::*;
use crate::codec::json_numpy;

const KEY: &str = "a-key-of-many-letters";

/// Status line and body of a plain HTTP request.
async fn http(server: &Server, request: &str) -> (String, String) {
    let mut stream = TcpStream::connect(server.address).await.expect("a connection");
    stream.write_all(request.as_bytes()).await.expect("sent");
    let mut reply = Vec::new();
    timeout(WAIT, stream.read_to_end(&mut reply)).await.expect("in time").expect("a reply");
    let reply = String::from_utf8(reply).expect("text");
    let (head, body) = reply.split_once("\r\n\r\n").expect("a head");
    (head.lines().next().unwrap_or_default().to_owned(), body.to_owned())
}

async fn get(server: &Server, path: &str) -> (String, String) {
    http(server, &format!("GET {path} HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")).await
}

#[tokio::test]
async fn only_the_key_opens_the_server_and_health_needs_none() {
    let server = Server::with(agent(1, Strategy::Sample, 1), Some(KEY), 4).await;
    for headers in [&[][..], &[("authorization", "Api-Key another-key-of-letters")]] {
        let error = server.connect_with(headers).await.err().expect("refused").to_string();
        assert!(error.contains("401"), "{error}");
    }
    let header = format!("Api-Key {KEY}");
    let mut client = server.connect_with(&[("authorization", &header)]).await.expect("accepted");
    client.receive_binary().await;
    assert_eq!(get(&server, "/healthz").await, ("HTTP/1.1 200 OK".to_owned(), "OK\n".to_owned()));
    assert_eq!(get(&server, "/health").await.1, "{\"status\":\"ok\"}\n");
    assert!(get(&server, "/config").await.0.contains("401"));
}

#[tokio::test]
async fn web_pages_are_refused_and_other_paths_are_named() {
    let server = Server::start(1).await;
    let error = server.connect_with(&[("origin", "http://a.page")]).await.err().expect("refused");
    assert!(error.to_string().contains("403"), "{error}");
    let (status, body) = get(&server, "/nothing").await;
    assert!(status.contains("404") && body.contains("POST /act, got GET /nothing"), "{body}");
    let (_, body) = get(&server, "/config").await;
    assert!(body.contains("\"policy\":\"echo\"") && body.contains("\"seed\":7"), "{body}");
}

#[tokio::test]
async fn a_client_over_the_limit_is_told_and_a_place_is_free_again_when_one_leaves() {
    let server = Server::with(agent(1, Strategy::Sample, 1), None, 1).await;
    let mut client = server.connect().await;
    client.receive_binary().await;
    let (status, body) = get(&server, "/healthz").await;
    assert!(status.contains("503") && body.contains("all 1 places"), "{body}");
    client.socket.close(None).await.expect("closed");
    drop(client);
    let deadline = tokio::time::Instant::now() + WAIT;
    while !get(&server, "/healthz").await.0.contains("200") {
        assert!(tokio::time::Instant::now() < deadline, "the place is never free");
    }
}

#[tokio::test]
async fn act_answers_in_the_form_of_the_request() {
    let server = Server::start(1).await;
    let array = Array::new(Dtype::U8, vec![SIDE, SIDE, 3], pixels(5)).expect("an image");
    let request = Value::map([
        ("image", json_numpy::array_value(&array)),
        ("instruction", Value::text("go")),
        ("rever", Value::map([("seed", Value::Integer(3))])),
    ]);
    let body = json_numpy::encode(&request).expect("JSON");
    for body in [body.clone(), json_numpy::encode_twice(&body)] {
        let head = format!(
            "POST /act HTTP/1.1\r\nHost: a\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        );
        let (status, reply) = http(&server, &head).await;
        assert!(status.contains("200"), "{status} {reply}");
        let reply = json_numpy::decode(reply.as_bytes()).expect("JSON");
        let action = json_numpy::array(&reply.value).expect("an array");
        assert_eq!(action.shape, [7]);
        assert_eq!(action.to_f32()[0], motion("go", &pixels(5), 3, 0, 0));
    }
    let head = "POST /act HTTP/1.1\r\nHost: a\r\nConnection: close\r\nContent-Length: 2\r\n\r\n{}";
    let (status, reply) = http(&server, head).await;
    assert!(status.contains("400") && reply.contains("expected an image under"), "{reply}");
}
