//! Every limit of the protocol; a message beyond one of them is refused, most of them before it is decoded.

/// Bytes of a [`crate::Request`]; the longest valid one is far below.
pub const REQUEST_BYTES_MAX: usize = 1024;
/// Bytes of a [`crate::Reply`]: the largest image and everything beside it.
pub const REPLY_BYTES_MAX: usize = 4 << 20;
/// Bytes of an [`crate::Open`].
pub const OPEN_BYTES_MAX: usize = 1024;
/// Bytes of an [`crate::Opening`].
pub const OPENING_BYTES_MAX: usize = 4096;
/// Bytes of a [`crate::Description`].
pub const DESCRIPTION_BYTES_MAX: usize = 256 << 10;
/// Bytes of a [`crate::Heartbeat`].
pub const HEARTBEAT_BYTES_MAX: usize = 512;
/// Bytes of an [`crate::EpisodeOutcome`].
pub const OUTCOME_BYTES_MAX: usize = 4096;
/// Bytes of a [`crate::VerifierUpdate`]: two hidden layers on a 4096-wide state in 32 bits fit.
pub const VERIFIER_UPDATE_BYTES_MAX: usize = 64 << 20;

/// The largest of the above: what a transport must be willing to carry.
pub const MESSAGE_BYTES_MAX: usize = VERIFIER_UPDATE_BYTES_MAX;

/// Bytes of a name: task, variant, run, strategy, holder, server, session, digest.
pub const NAME_BYTES_MAX: usize = 128;
/// Bytes of a text: instruction, reason, simulator.
pub const TEXT_BYTES_MAX: usize = 1024;
/// Height and width of an image in pixels.
pub const IMAGE_SIDE_MAX: usize = 1024;
/// Height and width of the tiles in which a step's image may come, in pixels.
pub const TILE_SIDE: usize = 16;
/// Maps and arrays inside one another.
pub const DEPTH_MAX: usize = 8;
/// Elements of an array or a map.
pub const ELEMENTS_MAX: usize = 4096;
/// Save slots of a session, numbered from 0.
pub const SLOTS_MAX: u32 = 16;
/// Sessions one server process may offer.
pub const SESSIONS_MAX: u32 = 256;
/// First seed that is too large: seeds fit a double, so that every language can hold them.
pub const SEED_END: u64 = 1 << 53;
/// Numbers of an action: a `Step` with so many is within its limit.
pub const ACTION_DIMENSIONS_MAX: usize = 128;
/// Numbers of a state.
pub const STATE_DIMENSIONS_MAX: usize = ELEMENTS_MAX;
/// Bytes of a body that a server takes off the network: what is beyond its own limit and below this is refused in words.
pub const SERVER_MESSAGE_BYTES_MAX: usize = 1 << 20;
