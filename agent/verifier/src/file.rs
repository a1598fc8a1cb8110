//! The file format of a verifier: safetensors with weights in f32 and the description as JSON in
//! the metadata.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use anyhow::{Context, ensure};
use decision::Stage;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use sha2::{Digest, Sha256};

use crate::verifier::FILE_BYTES_MAX;
use crate::{
    FeatureLayout, Layer, Network, Ranking, Standardisation, TERMS, TargetMap, TargetModel,
    VerifierDescription,
};

/// Metadata key of the description. There is only one key, because several would be written in
/// random order.
const DESCRIPTION_KEY: &str = "rever.verifier";
const MEAN: &str = "standardisation.mean";
const DEVIATION: &str = "standardisation.deviation";
const LAYERS: [&str; 3] = ["hidden_1", "hidden_2", "output"];
const RANKING: &str = "ranking.weight";
/// Prefixes of tensor names; the instruction follows.
const TARGETS: [(Stage, &str); 2] =
    [(Stage::Grasp, "target.grasp."), (Stage::Place, "target.place.")];

/// The content of a file.
pub struct Contents {
    /// The network that scores hidden states.
    pub network: Network,
    /// The ranking of candidates; `None` in the paper's verifier.
    pub ranking: Option<Ranking>,
    /// The description of the verifier.
    pub description: VerifierDescription,
}

/// Encodes a verifier. The same verifier always gives the same bytes.
pub fn encode(
    network: &Network,
    ranking: Option<&Ranking>,
    description: &VerifierDescription,
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
    if let Some(ranking) = ranking {
        let weights = ranking.weights();
        tensors.push((RANKING.to_owned(), vec![weights.len()], bytes_of(weights)));
        for (instruction, stage, map) in ranking.target_model().maps() {
            let name = format!("{}{instruction}", TARGETS[stage as usize].1);
            let numbers = map.coefficients().as_flattened();
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

/// Decodes a file. It must contain exactly the expected tensors with the expected shapes.
pub fn decode(bytes: &[u8]) -> anyhow::Result<Contents> {
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
    let description: VerifierDescription =
        serde_json::from_str(description).context("verifier description")?;

    let tensors = SafeTensors::deserialize(bytes).context("verifier file: expected safetensors")?;
    let tensors: Tensors<'_> =
        tensors.iter().map(|(name, view)| (current_name(name).into_owned(), view)).collect();
    let network = read_network(&tensors, &description)?;
    let ranking = match &description.ranking {
        Some(_) => Some(read_ranking(&tensors, description.action_length)?),
        None => None,
    };
    let maps = ranking.as_ref().map_or(0, |ranking| ranking.target_model().maps().count());
    let expected = 2 + 2 * LAYERS.len() + usize::from(ranking.is_some()) + maps;
    ensure!(
        tensors.len() == expected,
        "verifier file: expected {expected} tensors, got {}",
        tensors.len()
    );
    Ok(Contents { network, ranking, description })
}

type Tensors<'a> = BTreeMap<String, TensorView<'a>>;

/// The current name of a tensor; files of the first format use other names.
fn current_name(name: &str) -> Cow<'_, str> {
    match name.strip_prefix("aim.") {
        Some(rest) => format!("target.{rest}").into(),
        None if name == "choice.weight" => RANKING.into(),
        None => name.into(),
    }
}

fn read_network(
    tensors: &Tensors<'_>,
    description: &VerifierDescription,
) -> anyhow::Result<Network> {
    let [first, second] = description.options.hidden_sizes;
    let mut inputs = description.input_size;
    let standardisation = Standardisation {
        mean: read(tensors, MEAN, &[inputs])?,
        deviation: read(tensors, DEVIATION, &[inputs])?,
    };
    let mut layers = Vec::with_capacity(LAYERS.len());
    for (name, outputs) in LAYERS.iter().zip([first, second, 1]) {
        let weight = read(tensors, &format!("{name}.weight"), &[outputs, inputs])?;
        let bias = read(tensors, &format!("{name}.bias"), &[outputs])?;
        layers.push(Layer::new(weight, bias).with_context(|| format!("tensor {name}"))?);
        inputs = outputs;
    }
    let layers = layers.try_into().ok().context("verifier file: expected three layers")?;
    Network::new(standardisation, layers)
}

fn read_ranking(tensors: &Tensors<'_>, action_length: usize) -> anyhow::Result<Ranking> {
    let layout = FeatureLayout { action_length };
    let weights = read(tensors, RANKING, &[layout.length()])?;
    let mut target_model = TargetModel::default();
    for name in tensors.keys() {
        let stage =
            TARGETS.iter().find_map(|(stage, part)| Some((*stage, name.strip_prefix(part)?)));
        let Some((stage, instruction)) = stage else { continue };
        let numbers = read(tensors, name, &[TERMS, 2])?;
        let coefficients = numbers.as_chunks::<2>().0.try_into().expect("as many as terms");
        let map = TargetMap::new(coefficients).with_context(|| format!("tensor {name}"))?;
        target_model.insert(instruction, stage, map);
    }
    Ranking::new(layout, weights, target_model)
}

/// SHA-256 in hexadecimal.
pub fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

fn read(tensors: &Tensors<'_>, name: &str, shape: &[usize]) -> anyhow::Result<Vec<f32>> {
    let tensor = tensors
        .get(name)
        .with_context(|| format!("verifier file: expected tensor {name}, got none"))?;
    ensure!(
        tensor.dtype() == Dtype::F32 && tensor.shape() == shape,
        "tensor {name}: expected F32 {shape:?}, got {:?} {:?}",
        tensor.dtype(),
        tensor.shape()
    );
    Ok(tensor.data().chunks_exact(4).map(bytemuck::pod_read_unaligned).collect())
}
