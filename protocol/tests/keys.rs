//! Zenoh keys and the names in them.

use protocol::Keys;

#[test]
fn keys_lie_under_version_and_fleet() {
    let keys = Keys::new("home").expect("a name");
    let check =
        |key: Result<String, _>, expected| assert_eq!(key, Ok(format!("rever/3/home/{expected}")));
    check(keys.server("s1"), "server/s1");
    check(keys.describe("s1"), "server/s1/describe");
    check(keys.open("s1"), "server/s1/open");
    check(keys.heartbeat("s1"), "server/s1/heartbeat");
    check(keys.session("a"), "session/a");
    check(keys.request("a"), "session/a/request");
    check(keys.reply("a"), "session/a/reply");
    check(keys.outcome("run.1"), "outcome/run.1");
    check(keys.verifier("best_of-2"), "verifier/best_of-2");
    check(Ok(keys.servers()), "server/*");
    check(Ok(keys.heartbeats()), "server/*/heartbeat");
    check(Ok(keys.outcomes()), "outcome/*");
}

#[test]
fn names_are_found_in_keys() {
    let keys = Keys::new("home").expect("a name");
    assert_eq!(keys.server_of("rever/3/home/server/s1"), Some("s1"));
    assert_eq!(keys.server_of("rever/3/home/server/s1/heartbeat"), Some("s1"));
    assert_eq!(keys.session_of("rever/3/home/session/a"), Some("a"));
    assert_eq!(keys.server_of("rever/3/home/session/a"), None);
    assert_eq!(keys.server_of("rever/3/homes/server/s1"), None);
    assert_eq!(keys.server_of("rever/1/home/server/s1"), None);
}

#[test]
fn a_name_with_wildcards_or_slashes_is_refused() {
    for name in ["", "*", "**", "a/b", "a b", "$*", "a?b", "a#b", "ä", &"a".repeat(65)] {
        let error = Keys::new(name).expect_err(name);
        assert!(error.to_string().contains("expected 1 to 64 characters from"), "{error}");
    }
    assert!(Keys::new(&"a".repeat(64)).is_ok());
}
