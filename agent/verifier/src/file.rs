//! The verifier's file: safetensors with the weights in f32 and the description as JSON in the metadata.

use std::collections::HashMap;

use anyhow::{Context, ensure};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use sha2::{Digest, Sha256};

use super::{
    TargetModel, Choice, Description, FEATURES, FILE_BYTES_MAX, Layer, Network, Place, Stage,
    Standardisation, TERMS,
};

/// Metadata key of the description; one key, because the order of several would not be the same twice.
const DESCRIPTION_KEY: &str = "rever.verifier";
const MEAN: &str = "standardisation.mean";
const DEVIATION: &str = "standardisation.deviation";
const CHOICE: &str = "choice.weight";
/// Followed by the instruction.
const AIMS: [(Stage, &str); 2] = [(Stage::Grasp, "aim.grasp."), (Stage::Place, "aim.place.")];
const LAYERS: [&str; 3] = ["hidden_1", "hidden_2", "output"];

/// The bytes of a file: the same verifier always gives the same bytes.
pub fn encode(
    network: &Network,
    choice: Option<&Choice>,
    description: &Description,
) -> anyhow::Result<Vec<u8>> {
    let size = network.input_size();
    let Standardisation { mean, deviation } = network.standardisation();
    let mut tensors = vec![
        (MEAN.to_owned(), vec![size], bytes_of(mean)),
        (DEVIATION.to_owned(), vec![size], bytes_of(deviation)),
    ];
    for (name, layer) in LAYERS.iter().zip(network.layers()) {
        let shape = vec![layer.outputs(), layer.inputs()];
        tensors.push((format!("{name}.weight"), shape, bytes_of(layer.weight())));
        tensors.push((format!("{name}.bias"), vec![layer.outputs()], bytes_of(layer.bias())));
    }
    if let Some(choice) = choice {
        tensors.push((CHOICE.to_owned(), vec![FEATURES], bytes_of(choice.weights())));
        for (instruction, stage, place) in choice.target_model().places() {
            let name = format!("{}{instruction}", AIMS[stage as usize].1);
            let numbers = place.coefficients().as_flattened();
            tensors.push((name, vec![TERMS, 2], bytes_of(numbers)));
        }
    }
    let views = tensors
        .iter()
        .map(|(name, shape, bytes)| Ok((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?)));
    let views = views.collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    let description = serde_json::to_string(description).context("verifier description")?;
    let metadata = HashMap::from([(DESCRIPTION_KEY.to_owned(), description)]);
    Ok(safetensors::serialize(views, Some(metadata))?)
}

/// Reads a file's bytes; every tensor must be there with its size, and no other.
pub fn decode(bytes: &[u8]) -> anyhow::Result<(Network, Option<Choice>, Description)> {
    let bytes_found = bytes.len() as u64;
    ensure!(
        bytes_found <= FILE_BYTES_MAX,
        "verifier file: expected at most {FILE_BYTES_MAX} bytes, got {bytes_found}"
    );
    let (_, metadata) =
        SafeTensors::read_metadata(bytes).context("verifier file: expected safetensors")?;
    let description =
        metadata.metadata().as_ref().and_then(|metadata| metadata.get(DESCRIPTION_KEY));
    let description = description.with_context(|| {
        format!("verifier file: expected metadata {DESCRIPTION_KEY:?}, got none")
    })?;
    let description: Description =
        serde_json::from_str(description).context("verifier description")?;

    let tensors = SafeTensors::deserialize(bytes).context("verifier file: expected safetensors")?;
    let has_choice = description.choice.is_some();
    let target_model = if has_choice { read_aims(&tensors)? } else { TargetModel::default() };
    let expected = 2 + 2 * LAYERS.len() + usize::from(has_choice) + target_model.places().count();
    ensure!(
        tensors.len() == expected,
        "verifier file: expected {expected} tensors, got {}",
        tensors.len()
    );
    let mut outputs = [0; 3];
    outputs[..2].copy_from_slice(&description.options.hidden_sizes);
    outputs[2] = 1;
    let mut inputs = description.input_size;
    let standardisation = Standardisation {
        mean: read(&tensors, MEAN, &[inputs])?,
        deviation: read(&tensors, DEVIATION, &[inputs])?,
    };
    let mut layers = Vec::with_capacity(LAYERS.len());
    for (name, outputs) in LAYERS.iter().zip(outputs) {
        let weight = read(&tensors, &format!("{name}.weight"), &[outputs, inputs])?;
        layers.push(
            Layer::new(weight, read(&tensors, &format!("{name}.bias"), &[outputs])?)
                .with_context(|| format!("tensor {name}"))?,
        );
        inputs = outputs;
    }
    let layers: [Layer; 3] =
        layers.try_into().ok().context("verifier file: expected three layers")?;
    let choice = match &description.choice {
        Some(_) => {
            let weights = read(&tensors, CHOICE, &[FEATURES])?;
            Some(Choice::new(weights.try_into().expect("one per feature"), target_model)?)
        }
        None => None,
    };
    Ok((Network::new(standardisation, layers)?, choice, description))
}

fn read_aims(tensors: &SafeTensors<'_>) -> anyhow::Result<TargetModel> {
    let mut target_model = TargetModel::default();
    for name in tensors.names() {
        let found = AIMS.iter().find_map(|(stage, part)| Some((*stage, name.strip_prefix(part)?)));
        let Some((stage, instruction)) = found else { continue };
        let numbers = read(tensors, name, &[TERMS, 2])?;
        let pairs = numbers.as_chunks::<2>().0;
        let coefficients = pairs.try_into().expect("as many as terms");
        target_model.insert(instruction, stage, Place::new(coefficients).context(name.to_owned())?);
    }
    Ok(target_model)
}

/// SHA-256 in hexadecimal.
pub fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

fn read(tensors: &SafeTensors<'_>, name: &str, shape: &[usize]) -> anyhow::Result<Vec<f32>> {
    let tensor =
        tensors.tensor(name).with_context(|| format!("verifier file: expected tensor {name}"))?;
    ensure!(
        tensor.dtype() == Dtype::F32 && tensor.shape() == shape,
        "tensor {name}: expected F32 {shape:?}, got {:?} {:?}",
        tensor.dtype(),
        tensor.shape()
    );
    Ok(tensor.data().chunks_exact(4).map(bytemuck::pod_read_unaligned).collect())
}
