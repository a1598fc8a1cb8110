//! The protocol's tests; run with `REVER_UPDATE_GOLDEN=1` they rewrite `golden/`, which the Python tests read too.

/// One example of each message, the same as in the Python tests.
mod examples;
/// Each example's bytes are those in `golden/`, and read back as the example.
mod golden;
/// Zenoh keys and the names that may stand in them.
mod keys;
/// Bytes that no encoder of ours writes and every decoder must read.
mod other_forms;
/// The README says what the types say.
mod readme;
/// Bytes that must be refused, and the words for it.
mod refused;
/// Pictures as the tiles that changed.
mod tiles;
/// What zenoh's errors say once the places in its source are taken out.
mod transport;
