//! The real client and real servers over zenoh, on reliable and unreliable networks.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::{Observation, Open, Opening, PROTOCOL_VERSION, Reply, Reset, Transition, decode};
use runtime::fault::EnvironmentFault;
use runtime::wire::{Environment, Network, NetworkOptions, Timing};
use tokio::net::{TcpListener, TcpStream};

use crate::harness::repository;
use crate::relay::{Badness, Relay};
use crate::server::{Server, free_endpoint, open_router};

/// Maximum wait for an event that is nearly immediate on an idle machine.
const WAIT: Duration = Duration::from_secs(60);

fn open() -> Open {
    Open {
        protocol: PROTOCOL_VERSION,
        task: "widowx_spoon_on_towel".into(),
        variant: "default".into(),
        image_height: 64,
        image_width: 64,
        expert: true,
        holder: "test".into(),
    }
}

fn reset(task: &str, layout: Option<u32>) -> Reset {
    Reset { task: task.into(), variant: "default".into(), layout, seed: 2_000_000_007 }
}

fn spoon() -> Reset {
    reset("widowx_spoon_on_towel", Some(5))
}

async fn listen(fleet: &str) -> Network {
    let options = NetworkOptions { fleet: fleet.into(), ..NetworkOptions::default() };
    Network::open(options).await.expect("the network opens")
}

/// A network that others can reach, and a server connected to it.
async fn network_with_server(fleet: &str, arguments: &[&str]) -> (Network, Server) {
    let network = listen(fleet).await;
    let server = Server::start(&network.listening()[0], fleet, arguments);
    assert_eq!(network.servers(1, WAIT).await.servers.len(), 1, "the server describes itself");
    (network, server)
}

/// A second network that is connected to the server.
async fn connect(server: &Server, fleet: &str) -> Network {
    let connect = vec![server.endpoint.clone()];
    let options = NetworkOptions { connect, fleet: fleet.into(), ..NetworkOptions::default() };
    Network::open(options).await.expect("the network opens")
}

/// The agent's side of a relay.
async fn connect_through(endpoint: &str, timing: Timing) -> Network {
    let (connect, fleet) = (vec![endpoint.to_owned()], "agents".to_owned());
    let options = NetworkOptions { connect, fleet, timing, ..NetworkOptions::default() };
    let network = Network::open(options).await.expect("the network opens");
    assert_eq!(
        network.servers(1, WAIT).await.servers.len(),
        1,
        "the server is seen through the relay"
    );
    network
}

/// A peer that uses none of our code.
async fn stranger_to(server: &Server) -> zenoh::Session {
    let mut configuration = zenoh::Config::default();
    let endpoints = format!("[\"{}\"]", server.endpoint);
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", &endpoints),
        ("scouting/multicast/enabled", "false"),
    ] {
        configuration.insert_json5(key, value).expect("zenoh has this option");
    }
    zenoh::open(configuration).await.expect("the stranger connects")
}

/// The replies of two episodes that use every request: those of resets and restores, and those of
/// steps.
type Trajectory = (Vec<Observation>, Vec<Transition>);

async fn trajectory(network: &Network, server: &str) -> Result<Trajectory, EnvironmentFault> {
    let (mut observations, mut transitions) = (Vec::new(), Vec::new());
    let environment = Environment::open(network, server, open()).await?;
    let mut episode = environment.reset(spoon()).await?;
    observations.push(episode.observation().clone());
    for step in 0..12 {
        if step == 6 {
            episode.save(2).await?;
        }
        let action = episode.observation().expert_action.clone();
        let action = action.expect("the expert was asked for");
        transitions.push(episode.step(&action).await?);
    }
    episode.restore(2).await?;
    observations.push(episode.observation().clone());
    for _ in 0..3 {
        transitions.push(episode.step(&[0.01, 0.0, -0.005, 0.0, 0.0, 0.1, 1.0]).await?);
    }
    let episode = episode.finish().reset(reset("widowx_stack_cube", None)).await?;
    observations.push(episode.observation().clone());
    episode.finish().close().await?;
    Ok((observations, transitions))
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unreliable_network_gives_the_same_steps_as_a_reliable_one() {
    let (network, server) = network_with_server("good", &[]).await;
    let clean = trajectory(&network, &server.id).await.expect("a good wire");
    drop(server);
    let endpoint = free_endpoint();
    let badness = Badness { dropped: 150, doubled: 200, delay_ms_max: 60 };
    let relay = Relay::start(&endpoint, 7, badness).await;
    let server = Server::start(&endpoint, "servers", &[]);
    let timing = Timing {
        resend: Duration::from_millis(40),
        resend_max: Duration::from_millis(200),
        ..Timing::default()
    };
    let network = connect_through(&endpoint, timing).await;
    for _ in 0..3 {
        let lossy = trajectory(&network, &server.id).await.expect("a bad wire loses nothing");
        assert!(lossy.0 == clean.0, "a reset or a restore differs");
        assert_eq!(lossy.1.len(), clean.1.len());
        for (index, (lossy, clean)) in lossy.1.iter().zip(&clean.1).enumerate() {
            assert!(lossy == clean, "step {index} differs");
        }
    }
    let deeds = relay.deeds();
    for (name, count) in
        [("dropped", &deeds.dropped), ("doubled", &deeds.doubled), ("overtaken", &deeds.overtaken)]
    {
        let count = count.load(Ordering::SeqCst);
        assert!(count >= 5, "only {count} messages were {name}: the wire was not bad");
    }
    relay.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_server_is_detected_within_seconds_and_another_one_gives_the_same_steps() {
    let (network, mut first) = network_with_server("killed", &[]).await;
    let second = Server::start(&network.listening()[0], "killed", &[]);
    let whole = trajectory(&network, &first.id).await.expect("the first server lives");
    let environment = Environment::open(&network, &first.id, open()).await.expect("a session");
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    episode.step(&[0.0; 7]).await.expect("the first server lives");
    first.kill();
    let killed_at = Instant::now();
    let fault = loop {
        match episode.step(&[0.0; 7]).await {
            Ok(_) => assert!(killed_at.elapsed() < WAIT, "a dead server answers"),
            Err(fault) => break fault,
        }
    };
    assert_eq!(fault, EnvironmentFault::ServerLost { server: first.id.clone() });
    assert!(
        killed_at.elapsed() < Duration::from_secs(5),
        "the fault took {:?}",
        killed_at.elapsed()
    );
    let left: Vec<_> = network.servers(1, WAIT).await.servers.into_keys().collect();
    assert_eq!(left, std::slice::from_ref(&second.id));
    let again = trajectory(&network, &second.id).await.expect("the second server lives");
    assert!(again == whole, "another server gave other steps");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stuck_simulation_times_out_although_its_token_exists() {
    let endpoint = free_endpoint();
    let relay =
        Relay::start(&endpoint, 1, Badness { dropped: 0, doubled: 0, delay_ms_max: 0 }).await;
    let server = Server::start(&endpoint, "servers", &[]);
    let timing = Timing { silence_max: Duration::from_secs(3), ..Timing::default() };
    let network = connect_through(&endpoint, timing).await;
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    episode.step(&[0.0; 7]).await.expect("a step, for the first may take longer");
    relay.get_stuck();
    let fault = episode.step(&[0.0; 7]).await.expect_err("nothing passes");
    let EnvironmentFault::TimedOut { asked: "Step", waited_secs: 3..=10, .. } = fault else {
        panic!("expected to time out after 3 s, got {fault:?}")
    };
    relay.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restored_link_affects_no_episode() {
    let endpoint = free_endpoint();
    let router = open_router(&endpoint).await;
    let server = Server::start_behind_router(&endpoint, "restarted", &[]);
    let options = NetworkOptions {
        connect: vec![endpoint.clone()],
        listen_here: false,
        fleet: "restarted".into(),
        ..NetworkOptions::default()
    };
    let network = Network::open(options).await.expect("the network opens");
    assert_eq!(network.servers(1, WAIT).await.servers.len(), 1, "the server is found");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    episode.step(&[0.0; 7]).await.expect("a step");
    router.close().await.expect("the router goes");
    let router = open_router(&endpoint).await;
    let after = episode.step(&[0.0; 7]).await.expect("the same episode continues");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut undisturbed = environment.reset(spoon()).await.expect("an episode");
    undisturbed.step(&[0.0; 7]).await.expect("a step");
    let expected = undisturbed.step(&[0.0; 7]).await.expect("a step");
    assert!(after == expected, "no step is done twice or left out");
    router.close().await.expect("the router goes");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_link_to_a_listening_agent_is_reported() {
    let endpoint = free_endpoint();
    let options = NetworkOptions {
        listen: vec![endpoint.clone()],
        listen_here: false,
        fleet: "cut".into(),
        timing: Timing { link_max: Duration::from_secs(2), ..Timing::default() },
        ..NetworkOptions::default()
    };
    let network = Network::open(options).await.expect("the network opens");
    let cable = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let plug = format!("tcp/{}", cable.local_addr().expect("a bound listener has an address"));
    let carrying = tokio::spawn(async move {
        let (mut near, _) = cable.accept().await?;
        let mut far = TcpStream::connect(endpoint.trim_start_matches("tcp/")).await?;
        tokio::io::copy_bidirectional(&mut near, &mut far).await
    });
    let server = Server::start_behind_router(&plug, "cut", &[]);
    assert_eq!(network.servers(1, WAIT).await.servers.len(), 1, "the server is found");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    carrying.abort();
    let fault = episode.step(&[0.0; 7]).await.expect_err("nothing carries it");
    assert_eq!(fault, EnvironmentFault::LinkLost { server: server.id.clone() });
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_ends_with_its_holder() {
    let (network, server) = network_with_server("holder", &["--sessions", "1"]).await;
    let holder = connect(&server, "holder").await;
    assert_eq!(holder.servers(1, WAIT).await.servers.len(), 1, "the server describes itself");
    let environment = Environment::open(&holder, &server.id, open()).await.expect("a session");
    let fault =
        Environment::open(&network, &server.id, open()).await.expect_err("one session at once");
    assert_eq!(
        fault,
        EnvironmentFault::Refused { reason: "all 1 sessions are in use, by test".into() }
    );
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    episode.step(&[0.0; 7]).await.expect("a step");
    drop(episode);
    assert_eq!(sessions_become(&network, &server.id, 0).await, 0, "a dropped session lives on");
    let environment = Environment::open(&holder, &server.id, open()).await.expect("it is free");
    let _episode = environment.reset(spoon()).await.expect("an episode");
    assert_eq!(sessions_become(&network, &server.id, 1).await, 1, "the session is not counted");
    holder.close().await.expect("the holder goes");
    assert_eq!(
        sessions_become(&network, &server.id, 0).await,
        0,
        "the session lives on without its holder"
    );
    Environment::open(&network, &server.id, open()).await.expect("the session is free again");
}

/// Waits until the server has this number of sessions in use; returns the last number.
async fn sessions_become(network: &Network, server: &str, expected: u32) -> u32 {
    let deadline = Instant::now() + WAIT;
    loop {
        let sessions = network.describe(server).await.expect("a description").sessions;
        if sessions == expected || Instant::now() > deadline {
            return sessions;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_requests_are_refused_with_a_reason_and_change_nothing() {
    let (network, server) = network_with_server("wrong", &[]).await;
    let check = |result: Result<(), EnvironmentFault>, words: &str| match result {
        Err(EnvironmentFault::Refused { reason }) => assert!(reason.contains(words), "{reason}"),
        other => panic!("expected a refusal with {words:?}, got {other:?}"),
    };
    let unknown = Open { task: "widowx_fold_towel".into(), ..open() };
    let opened = Environment::open(&network, &server.id, unknown).await.map(drop);
    check(opened, "task widowx_fold_towel: expected one of widowx_spoon_on_towel");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let far = environment.reset(reset("widowx_stack_cube", Some(24))).await.map(drop);
    check(far, "24");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut episode = environment.reset(spoon()).await.expect("an episode");
    check(
        episode.step(&[f32::NAN; 7]).await.map(drop),
        "action: expected finite numbers, got nan at index 0",
    );
    check(episode.restore(3).await, "slot: expected one of [], got 3");
    check(episode.save(16).await, "slot: expected 0 to 15, got 16");
    let first = episode.step(&[0.0; 7]).await.expect("the episode continues");
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let mut undisturbed = environment.reset(spoon()).await.expect("an episode");
    assert!(
        undisturbed.step(&[0.0; 7]).await.expect("a step") == first,
        "a refused request changed the world"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_requests_are_refused_with_a_reason() {
    let (network, server) = network_with_server("strange", &[]).await;
    let environment = Environment::open(&network, &server.id, open()).await.expect("a session");
    let session = environment.session().to_owned();
    let episode = environment.reset(spoon()).await.expect("an episode");
    let stranger = stranger_to(&server).await;
    let golden = |name: &str| {
        std::fs::read(repository().join("protocol/golden").join(name))
            .expect("the golden file is there")
    };
    let replies = stranger
        .declare_subscriber(format!("rever/3/strange/session/{session}/reply"))
        .await
        .expect("a subscriber");
    for (request, sequence, words) in [
        (vec![0xc0; 1025], 0, "request has 1025 bytes, limit 1024"),
        (golden("refused/trailing.msgpack"), 0, "got 1 more bytes"),
        (
            golden("refused/nan.msgpack"),
            2,
            "request is invalid: action: expected finite numbers, got nan at index 5",
        ),
        (golden("request_restore.msgpack"), 70_000, "sequence: expected 3, got 70000"),
    ] {
        stranger
            .put(format!("rever/3/strange/session/{session}/request"), request)
            .await
            .expect("sent");
        let sample = tokio::time::timeout(WAIT, replies.recv_async())
            .await
            .expect("an answer")
            .expect("a sample");
        let reply: Reply = decode(&sample.payload().to_bytes()).expect("a reply");
        let Reply::Refused { sequence: number, reason } = reply else {
            panic!("expected a refusal, got {reply:?}")
        };
        assert!(number == sequence && reason.contains(words), "{number}: {reason}");
    }
    for (payload, words) in [
        (
            golden("refused/protocol_and_fields.msgpack"),
            "open is invalid: expected protocol 3, got protocol 4",
        ),
        (vec![0xc0; 1025], "open has 1025 bytes, limit 1024"),
    ] {
        let key = format!("rever/3/strange/server/{}/open", server.id);
        let answers = stranger.get(key).payload(payload).timeout(WAIT).await.expect("asked");
        let sample =
            answers.recv_async().await.expect("an answer").into_result().expect("a sample");
        let opening: Opening = decode(&sample.payload().to_bytes()).expect("an opening");
        assert_eq!(opening, Opening::Refused { reason: words.into() });
    }
    drop(episode);
}
