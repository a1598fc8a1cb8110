//! Reads a checkpoint's files: configuration, tokenizer, prompt, action bins, weights, completions.

pub mod actions;
pub mod completion;
pub mod confidence;
pub mod config;
pub mod digest_cache;
pub mod identity;
pub mod options;
pub mod parse;
pub mod prompt;
pub mod shards;
pub mod weights;
