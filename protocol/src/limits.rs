//! All limits of the protocol. A message beyond a limit is refused, in most cases before it is
//! decoded.

/// Size of a [`crate::Request`] in bytes; the longest valid request is far smaller.
pub const REQUEST_BYTES_MAX: usize = 1024;
/// Size of a [`crate::Reply`] in bytes: the largest image and all other fields.
pub const REPLY_BYTES_MAX: usize = 4 << 20;
/// Size of an [`crate::Open`] in bytes.
pub const OPEN_BYTES_MAX: usize = 1024;
/// Size of an [`crate::Opening`] in bytes.
pub const OPENING_BYTES_MAX: usize = 4096;
/// Size of a [`crate::Description`] in bytes.
pub const DESCRIPTION_BYTES_MAX: usize = 256 << 10;
/// Size of a [`crate::Heartbeat`] in bytes.
pub const HEARTBEAT_BYTES_MAX: usize = 512;
/// Size of an [`crate::EpisodeOutcome`] in bytes.
pub const OUTCOME_BYTES_MAX: usize = 4096;
/// Size of a [`crate::VerifierUpdate`] in bytes: enough for two hidden layers on a 4096-dimensional
/// state in 32 bits.
pub const VERIFIER_UPDATE_BYTES_MAX: usize = 64 << 20;

/// The largest of these sizes: the transport must accept it.
pub const MESSAGE_BYTES_MAX: usize = VERIFIER_UPDATE_BYTES_MAX;

/// Length of a name in bytes: task, variant, run, strategy, holder, server, session, digest.
pub const NAME_BYTES_MAX: usize = 128;
/// Length of a text in bytes: instruction, reason, simulator.
pub const TEXT_BYTES_MAX: usize = 1024;
/// Height and width of an image, in pixels.
pub const IMAGE_SIDE_MAX: usize = 1024;
/// Height and width of a tile, in pixels. A step's image may be sent as the tiles that changed.
pub const TILE_SIDE: usize = 16;
/// Nesting depth of maps and arrays.
pub const DEPTH_MAX: usize = 8;
/// Elements in an array or a map.
pub const ELEMENTS_MAX: usize = 4096;
/// Save slots of a session, numbered from 0.
pub const SLOTS_MAX: u32 = 16;
/// Sessions that one server process may offer.
pub const SESSIONS_MAX: u32 = 256;
/// Exclusive upper bound of a seed: every seed is exact as a double, so that every language can
/// hold it.
pub const SEED_END: u64 = 1 << 53;
/// Dimensions of an action; a `Step` of this length is within its size limit.
pub const ACTION_DIMENSIONS_MAX: usize = 128;
/// Dimensions of a state.
pub const STATE_DIMENSIONS_MAX: usize = ELEMENTS_MAX;
/// Size up to which a server receives a body at all, in bytes. A body between a message's own limit
/// and this one is refused with a reason; a larger one is dropped.
pub const SERVER_MESSAGE_BYTES_MAX: usize = 1 << 20;
