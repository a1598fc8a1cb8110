//! Tests of the protocol. With `REVER_UPDATE_GOLDEN=1` they rewrite `golden/`, which the Python
//! tests read too.

/// One example of each message, the same as in the Python tests.
mod examples;
/// The encoding of each example equals its golden file and decodes to the example.
mod golden;
/// Zenoh keys and the names in them.
mod keys;
/// Encodings that our encoder does not produce and that every decoder must accept.
mod other_forms;
/// The README agrees with the types.
mod readme;
/// Encodings that must be refused, with the expected reasons.
mod refused;
/// Images as changed tiles.
mod tiles;
/// zenoh's errors without the source locations.
mod transport;
