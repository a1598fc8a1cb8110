//! Clients against scripted servers on real sockets.
