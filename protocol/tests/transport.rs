//! zenoh's errors without the source locations.

use protocol::transport::in_words;

#[test]
fn an_error_keeps_its_cause_and_loses_the_paths_of_the_build() {
    let error = "Can not create a new TCP listener bound to tcp/127.0.0.1:1: [127.0.0.1:1: Address already in use \
                 (os error 98) at /root/.cargo/registry/src/zenoh-link-commons/src/tcp.rs:61.] at \
                 /root/.cargo/registry/src/unicast.rs:338.";
    let expected = "Can not create a new TCP listener bound to tcp/127.0.0.1:1: [127.0.0.1:1: Address already in use \
                    (os error 98)]";
    assert_eq!(in_words(error), expected);
    assert_eq!(in_words("cannot listen at /tmp/socket"), "cannot listen at /tmp/socket");
}
