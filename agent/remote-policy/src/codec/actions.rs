//! The actions of a reply: one action, or a chunk of actions for consecutive control steps.

use anyhow::{Context, Result, bail, ensure};

use super::{Array, Value};

/// Maximum number of actions in a chunk.
pub const STEPS_MAX: usize = 1024;
/// Maximum number of dimensions of an action.
pub const DIMENSIONS_MAX: usize = 64;

/// Reads actions of shape [dimensions] or [steps, dimensions]; further dimensions of length 1 in
/// front are dropped.
pub fn actions(value: &Value<'_>) -> Result<Vec<Vec<f32>>> {
    read(value).context("actions")
}

fn read(value: &Value<'_>) -> Result<Vec<Vec<f32>>> {
    actions_of(&Array::from_value(value)?)
}

/// As [`actions`], of a decoded array.
pub fn actions_of(array: &Array<'_>) -> Result<Vec<Vec<f32>>> {
    let mut shape = &array.shape[..];
    while let [1, rest @ ..] = shape
        && rest.len() > 1
    {
        shape = rest;
    }
    let (steps, dimensions) = match shape {
        [dimensions] => (1, *dimensions),
        [steps, dimensions] => (*steps, *dimensions),
        _ => bail!("expected the shape [steps, dimensions], got {:?}", array.shape),
    };
    ensure!((1..=STEPS_MAX).contains(&steps), "expected 1 to {STEPS_MAX} steps, got {steps}");
    ensure!(
        (1..=DIMENSIONS_MAX).contains(&dimensions),
        "expected 1 to {DIMENSIONS_MAX} dimensions, got {dimensions}"
    );
    let numbers = array.to_f32();
    ensure!(
        numbers.iter().all(|number| number.is_finite()),
        "expected finite numbers, got NaN or infinity"
    );
    Ok(numbers.chunks_exact(dimensions).map(<[f32]>::to_vec).collect())
}

/// The array of a chunk, whose actions have one length.
pub fn actions_array(actions: &[Vec<f32>]) -> Result<Array<'static>> {
    let dimensions = actions.first().map_or(0, Vec::len);
    Array::of_f32(vec![actions.len(), dimensions], &actions.concat()).context("actions")
}
