"""The limits of the protocol. A message beyond a limit is refused, mostly before decoding."""

REQUEST_BYTES_MAX = 1024
REPLY_BYTES_MAX = 4 << 20
OPEN_BYTES_MAX = 1024
OPENING_BYTES_MAX = 4096
DESCRIPTION_BYTES_MAX = 256 << 10
HEARTBEAT_BYTES_MAX = 512
OUTCOME_BYTES_MAX = 4096
VERIFIER_UPDATE_BYTES_MAX = 64 << 20
MESSAGE_BYTES_MAX = VERIFIER_UPDATE_BYTES_MAX  # the largest message of a transport
# What a server receives: a larger message is dropped, a smaller one beyond its limit is refused.
SERVER_MESSAGE_BYTES_MAX = 1 << 20

NAME_BYTES_MAX = 128  # task, variant, run, strategy, holder, server, session, digest
TEXT_BYTES_MAX = 1024  # instruction, reason, simulator
IMAGE_SIDE_MAX = 1024  # pixels
TILE_SIDE = 16  # pixels per side of a tile
DEPTH_MAX = 8  # nesting of maps and arrays
ELEMENTS_MAX = 4096  # of an array or a map
SLOTS_MAX = 16  # save slots of a session, numbered from 0
SESSIONS_MAX = 256  # of one server process
FLOAT_MAX = float.fromhex("0x1.fffffep127")  # the largest 32-bit float
SEED_END = 1 << 53  # the first seed that is too large: seeds must be exact in a double
ACTION_DIMENSIONS_MAX = 128
STATE_DIMENSIONS_MAX = ELEMENTS_MAX
