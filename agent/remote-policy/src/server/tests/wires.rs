//! openpi's and vla-eval's wires and `/act`: frames, episodes, seeds, chunks, errors.

use decision::{TaskId, episode_name, sampling_seed, step_seed};

use super::*;

const KEYS: KeyForm = KeyForm::Bytes;

fn observation(prompt: &str, shade: u8, rever: Option<Value<'static>>) -> Value<'static> {
    let mut fields = vec![
        ("observation/image", image(shade, KEYS)),
        ("prompt", Value::Text(prompt.to_owned().into())),
    ];
    fields.extend(rever.map(|fields| ("rever", fields)));
    Value::map(fields)
}

fn message(kind: &'static str, payload: Value<'static>, sequence: i128) -> Value<'static> {
    Value::map([
        ("type", Value::text(kind)),
        ("payload", payload),
        ("seq", Value::Integer(sequence)),
        ("timestamp", Value::Float(0.0)),
    ])
}

fn hello() -> Value<'static> {
    message("hello", Value::map([("protocol_version", Value::Integer(1))]), 1)
}

fn seen(shade: u8) -> Value<'static> {
    Value::map([
        ("images", Value::map([("primary", image(shade, KeyForm::Text))])),
        ("task_description", Value::text("go")),
    ])
}

/// Kind, sequence and x motion (NaN without) of a vla-eval message.
async fn answer(client: &mut Client) -> (String, i128, f32) {
    let frame = client.receive_binary().await;
    read(&frame, |value| {
        let kind = value.field("type").expect("type").as_text().expect("text").to_owned();
        let sequence = value.field("seq").expect("seq").as_integer().expect("an integer");
        let actions = value.field("payload").expect("payload").get("actions");
        (kind, sequence, actions.map_or(f32::NAN, |actions| motions(actions)[0]))
    })
}

async fn openpi(client: &mut Client, request: Value<'static>) -> Vec<f32> {
    client.send(&request).await;
    read(&client.receive_binary().await, |value| motions(value.field("actions").expect("actions")))
}

#[tokio::test]
async fn an_openpi_client_gets_metadata_and_the_actions_of_the_documented_seeds() {
    let server = Server::start(2).await;
    let mut client = server.connect().await;
    read(&client.receive_binary().await, |metadata| {
        let announced = metadata.field("rever").expect("the announcement");
        assert_eq!(announced.field("version").expect("a version"), &Value::Integer(1));
    });
    let go = |seed, step| motion("go", &pixels(3), seed, 0, step);
    let episode = |name: &str| sampling_seed(name, 7);
    // Without a name, the prompt and a count name the episode.
    let first = episode("go/default/0");
    let expected = vec![go(step_seed(first, 0), 0), go(step_seed(first, 0), 1)];
    assert_eq!(openpi(&mut client, observation("go", 3, None)).await, expected);
    // Two actions were executed.
    let expected = vec![go(step_seed(first, 2), 0), go(step_seed(first, 2), 1)];
    assert_eq!(openpi(&mut client, observation("go", 3, None)).await, expected);
    openpi(&mut client, observation("stop", 3, None)).await;
    let third = step_seed(episode("go/default/2"), 0);
    assert_eq!(openpi(&mut client, observation("go", 3, None)).await[0], go(third, 0));
    // A named episode has the seeds of an evaluation.
    let name = episode_name(&TaskId::default_of("stack"), 4);
    let named = || Some(Value::map([("episode", Value::text("stack/default/4"))]));
    for step in [0, 2] {
        let seed = step_seed(sampling_seed(&name, 7), step);
        assert_eq!(openpi(&mut client, observation("go", 3, named())).await[0], go(seed, 0));
    }
    // A seed of the request's own is used as it is.
    let own = Some(Value::map([("seed", Value::Integer(11)), ("candidates", Value::Integer(3))]));
    assert_eq!(openpi(&mut client, observation("go", 3, own)).await[0], go(11, 0));
}

#[tokio::test]
async fn a_failed_openpi_request_is_told_in_text_and_closes_the_connection() {
    let server = Server::start(1).await;
    let bad = Value::map([("prompt", Value::text("go"))]);
    for (request, expected) in [
        (bad, "observation: expected an image under one of observation/image"),
        (observation("fail", 1, None), "policy: expected another instruction"),
        (Value::Integer(3), "openpi frame: expected a map, got an integer"),
    ] {
        let mut client = server.connect().await;
        client.receive_binary().await;
        client.send(&request).await;
        match client.receive().await {
            Message::Text(text) => assert!(text.starts_with(expected), "{text}"),
            other => panic!("expected text, got {other:?}"),
        }
        let (code, reason) = client.closed().await;
        assert_eq!(code, 1011);
        assert!(expected.starts_with(&reason[..30]), "{reason}");
    }
}

#[tokio::test]
async fn a_vla_eval_client_plays_episodes_with_the_seeds_of_an_evaluation() {
    let server = Server::start(1).await;
    let mut client = server.connect().await;
    client.send(&hello()).await;
    let (kind, sequence, _) = answer(&mut client).await;
    assert_eq!((&*kind, sequence), ("hello", 1));
    for number in [2, 5] {
        let task = Value::map([
            ("name", Value::text("stack/wide")),
            ("episode_idx", Value::Integer(number)),
        ]);
        client.send(&message("episode_start", Value::map([("task", task)]), 2)).await;
        let seed = sampling_seed(&format!("stack/wide/{number}"), 7);
        for step in 0..3 {
            client.send(&message("observation", seen(9), 3 + i128::from(step))).await;
            let expected = motion("go", &pixels(9), step_seed(seed, step), 0, 0);
            let (kind, sequence, x) = answer(&mut client).await;
            assert_eq!((&*kind, sequence, x), ("action", 3 + i128::from(step), expected));
        }
        client.send(&message("episode_end", Value::map([]), 6)).await;
    }
}

#[tokio::test]
async fn a_vla_eval_client_that_greets_late_is_understood_and_errors_keep_the_connection() {
    let server = Server::start(1).await;
    let mut client = server.connect().await;
    // The server has not waited any longer.
    let (kind, _, _) = answer(&mut client).await;
    assert_eq!(kind, "hello");
    client.send(&hello()).await;
    client.send(&message("observation", Value::map([]), 2)).await;
    let (kind, sequence, _) = answer(&mut client).await;
    assert_eq!((&*kind, sequence), ("error", 2));
    client.send(&message("observation", seen(1), 3)).await;
    let (kind, sequence, _) = answer(&mut client).await;
    assert_eq!((&*kind, sequence), ("action", 3));
    // What is no message closes the connection, after an error.
    client.send(&Value::map([("type", Value::text("hallo"))])).await;
    assert_eq!(answer(&mut client).await.0, "error");
    let (code, reason) = client.closed().await;
    assert_eq!(code, 1007);
    assert!(reason.starts_with("vla-eval message: type: expected one of hello"), "{reason}");
}

#[tokio::test]
async fn a_wrong_start_of_an_episode_is_answered_with_its_first_observation() {
    let server = Server::start(1).await;
    let mut client = server.connect().await;
    client.send(&hello()).await;
    answer(&mut client).await;
    let task = Value::map([("name", Value::text(""))]);
    client.send(&message("episode_start", Value::map([("task", task)]), 2)).await;
    // vla-eval's client takes the next frame as the answer to its observation.
    for (observation, expected) in [(3, "error"), (4, "action")] {
        client.send(&message("observation", seen(1), observation)).await;
        let (kind, sequence, _) = answer(&mut client).await;
        assert_eq!((&*kind, sequence), (expected, observation));
    }
}

#[tokio::test]
async fn vla_eval_gets_a_chunk_one_action_at_a_time() {
    let server = Server::start(3).await;
    let mut client = server.connect().await;
    client.send(&hello()).await;
    answer(&mut client).await;
    let task = Value::map([("name", Value::text("stack")), ("episode_idx", Value::Integer(0))]);
    client.send(&message("episode_start", Value::map([("task", task)]), 2)).await;
    let seed = sampling_seed("stack/default/0", 7);
    for step in 0..5 {
        client.send(&message("observation", seen(step), i128::from(step) + 3)).await;
        // One decision per three actions, on the observation before the first.
        let decided = step / 3 * 3;
        let seed = step_seed(seed, u32::from(decided));
        let expected = motion("go", &pixels(decided), seed, 0, usize::from(step % 3));
        assert_eq!(answer(&mut client).await.2, expected);
    }
}

#[tokio::test]
async fn clients_at_once_do_not_change_each_others_answers() {
    let server = Server::with(agent(1, Strategy::FirstWellFormed, 3), None, 16).await;
    let play = |number: u8| {
        let server = &server;
        async move {
            let mut client = server.connect().await;
            client.receive_binary().await;
            let seed = sampling_seed(&format!("task {number}/default/0"), 7);
            let prompt = format!("task {number}");
            for step in 0..20_u8 {
                let expected = motion(&prompt, &pixels(step), step_seed(seed, step.into()), 0, 0);
                let got = openpi(&mut client, observation(&prompt, step, None)).await;
                assert_eq!(got, [expected], "client {number}, step {step}");
            }
        }
    };
    futures_util::future::join_all((0..8).map(play)).await;
}

#[tokio::test]
async fn a_stopped_server_says_so() {
    let server = Server::start(1).await;
    let mut client = server.connect().await;
    client.receive_binary().await;
    server.stop();
    assert_eq!(client.closed().await, (1001, "the server stops".to_owned()));
}
