//! Profiles that come with the program, and profiles to refuse.
