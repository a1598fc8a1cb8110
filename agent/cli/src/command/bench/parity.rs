//! `rever bench parity`: what agent/training/reference.py compares with the reference.

use std::collections::HashMap;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use runtime::servers::Host;
use safetensors::serialize_to_file;
use safetensors::tensor::{Dtype, TensorView};

use crate::bench::read_observations;
use crate::command::policy::PolicyArguments;
use crate::command::{WrongUsage, output_file};

/// Write prompt ids, greedy tokens, logits and actions of a checkpoint, for agent/training/reference.py
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    policy: PolicyArguments,
    /// File of observations of the checkpoint's image size: images and instructions
    #[arg(long, value_name = "FILE")]
    observations: PathBuf,
    /// File to write: for each observation I the tensors I.prompt, I.tokens, I.logits and, if it is well formed, I.action
    #[arg(long, value_name = "FILE", value_parser = output_file)]
    tensors: PathBuf,
}

/// Completes each observation and writes the file.
pub fn run(arguments: &Arguments, host: &Host) -> Result<()> {
    let observations = read_observations(&arguments.observations)?;
    let loaded = arguments.policy.load(host)?;
    let missing =
        || WrongUsage(format!("bench parity: expected a local checkpoint, got {}", loaded.name));
    let policy = loaded.checkpoint.as_deref().with_context(missing)?;
    let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    let mut metadata = HashMap::new();
    metadata.insert("digest".to_owned(), loaded.policy.info().digest.clone());
    for (index, observation) in observations.iter().enumerate() {
        let trace = policy.greedy_trace(&observation.image, &observation.instruction)?;
        let shape = vec![trace.tokens.len() + 1, trace.vocabulary];
        let name = |part: &str| format!("{index}.{part}");
        for (part, ids) in [("prompt", &trace.prompt), ("tokens", &trace.tokens)] {
            let bytes = ids.iter().flat_map(|&id| i64::from(id).to_le_bytes()).collect();
            tensors.push((name(part), Dtype::I64, vec![ids.len()], bytes));
        }
        let bytes = |numbers: &[f32]| numbers.iter().flat_map(|one| one.to_le_bytes()).collect();
        tensors.push((name("logits"), Dtype::F32, shape, bytes(&trace.logits)));
        match &trace.action {
            Ok(action) => {
                tensors.push((name("action"), Dtype::F32, vec![action.len()], bytes(action)));
            }
            Err(reason) => {
                metadata.insert(name("malformed"), reason.clone());
            }
        }
        println!("observation {index}: {} tokens", trace.tokens.len());
    }
    let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
        Ok((name, TensorView::new(*dtype, shape.clone(), bytes)?))
    });
    let views = views.collect::<Result<Vec<_>>>()?;
    serialize_to_file(views, Some(metadata), &arguments.tensors)
        .with_context(|| format!("cannot write {}", arguments.tensors.display()))
}
