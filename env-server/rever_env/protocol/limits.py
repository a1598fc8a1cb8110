"""Every limit of the protocol; a message beyond one of them is refused, most before decoding."""

REQUEST_BYTES_MAX = 1024
REPLY_BYTES_MAX = 4 << 20
OPEN_BYTES_MAX = 1024
OPENING_BYTES_MAX = 4096
DESCRIPTION_BYTES_MAX = 256 << 10
HEARTBEAT_BYTES_MAX = 512
OUTCOME_BYTES_MAX = 4096
VERIFIER_UPDATE_BYTES_MAX = 64 << 20
MESSAGE_BYTES_MAX = VERIFIER_UPDATE_BYTES_MAX  # what a transport must be willing to carry
# What a server takes off the network: beyond its own limit and below this it refuses in words.
SERVER_MESSAGE_BYTES_MAX = 1 << 20

NAME_BYTES_MAX = 128  # task, variant, run, strategy, holder, server, session, digest
TEXT_BYTES_MAX = 1024  # instruction, reason, simulator
IMAGE_SIDE_MAX = 1024  # pixels
TILE_SIDE = 16  # pixels, of the tiles in which a step's image may come
DEPTH_MAX = 8  # maps and arrays inside one another
ELEMENTS_MAX = 4096  # of an array or a map
SLOTS_MAX = 16  # save slots of a session, numbered from 0
SESSIONS_MAX = 256  # of one server process
FLOAT_MAX = float.fromhex("0x1.fffffep127")  # of 32 bits, in which all of them are written
SEED_END = 1 << 53  # first seed that is too large: seeds fit a double
ACTION_DIMENSIONS_MAX = 128
STATE_DIMENSIONS_MAX = ELEMENTS_MAX
