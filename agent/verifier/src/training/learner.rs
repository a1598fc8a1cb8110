//! The verifier's network during training: candle tensors with equation 4 as the loss.

use anyhow::ensure;
use candle_core::{Device, Tensor, Var};
use candle_nn::{Linear, Module};
use rand::Rng;

use crate::{Layer, Network, Standardisation};

/// Three affine layers with trainable weights.
pub struct Learner {
    variables: [(Var, Var); 3],
    layers: [Linear; 3],
}

/// Training samples as tensors.
pub struct Samples {
    /// (samples, input size), standardised.
    hidden: Tensor,
    /// (samples): 1 for a success, 0 for a failure.
    labels: Tensor,
    /// (samples): the class weight of equation 4.
    weights: Tensor,
}

impl Samples {
    /// Standardises the rows and assigns class weights.
    pub fn new<'a>(
        standardisation: &Standardisation,
        rows: impl Iterator<Item = &'a [f32]>,
        labels: &[bool],
        positive_share: f64,
    ) -> anyhow::Result<Samples> {
        let hidden: Vec<f32> = rows.flat_map(|row| standardisation.apply(row)).collect();
        let shape = (labels.len(), standardisation.mean.len());
        let (positive, negative) = (0.5 / positive_share, 0.5 / (1.0 - positive_share));
        let weights = labels.iter().map(|label| if *label { positive } else { negative } as f32);
        Ok(Samples {
            hidden: Tensor::from_vec(hidden, shape, &Device::Cpu)?,
            weights: Tensor::from_iter(weights, &Device::Cpu)?,
            labels: Tensor::from_iter(
                labels.iter().map(|label| f32::from(u8::from(*label))),
                &Device::Cpu,
            )?,
        })
    }
}

impl Learner {
    /// Initialises the weights uniformly within 1 / sqrt(inputs), so that every layer keeps the
    /// scale of its input.
    ///
    /// They are sampled here because candle's CPU generator has no seed.
    pub fn new(
        input_size: usize,
        hidden_sizes: [usize; 2],
        random: &mut impl Rng,
    ) -> anyhow::Result<Learner> {
        let [first, second] = hidden_sizes;
        let mut layer = |inputs: usize, outputs: usize| -> candle_core::Result<(Var, Var)> {
            let bound = 1.0 / (inputs as f32).sqrt();
            let weight: Vec<f32> =
                (0..inputs * outputs).map(|_| random.random_range(-bound..bound)).collect();
            let weight = Tensor::from_vec(weight, (outputs, inputs), &Device::Cpu)?;
            let bias = Tensor::zeros(outputs, candle_core::DType::F32, &Device::Cpu)?;
            Ok((Var::from_tensor(&weight)?, Var::from_tensor(&bias)?))
        };
        let variables = [layer(input_size, first)?, layer(first, second)?, layer(second, 1)?];
        // A variable's tensor shares its storage, so the layers see every optimizer step.
        let layers = variables.each_ref().map(|(weight, bias)| {
            Linear::new(weight.as_tensor().clone(), Some(bias.as_tensor().clone()))
        });
        Ok(Learner { variables, layers })
    }

    /// All trainable variables.
    pub fn variables(&self) -> Vec<Var> {
        self.variables.iter().flat_map(|(weight, bias)| [weight.clone(), bias.clone()]).collect()
    }

    /// Equation 4 for one batch of samples.
    pub fn loss(&self, samples: &Samples, batch: &[u32]) -> anyhow::Result<Tensor> {
        let batch = Tensor::new(batch, &Device::Cpu)?;
        let logits = self.forward(&samples.hidden.index_select(&batch, 0)?)?;
        let labels = samples.labels.index_select(&batch, 0)?;
        Ok((cross_entropy(&logits, &labels)? * samples.weights.index_select(&batch, 0)?)?
            .mean_all()?)
    }

    /// (samples, input size) -> (samples) logits.
    fn forward(&self, hidden: &Tensor) -> candle_core::Result<Tensor> {
        let [first, second, last] = &self.layers;
        let values = second.forward(&first.forward(hidden)?.relu()?)?.relu()?;
        // (samples, 1) -> (samples)
        last.forward(&values)?.squeeze(1)
    }

    /// The current weights as a network for scoring.
    pub fn network(&self, standardisation: &Standardisation) -> anyhow::Result<Network> {
        let mut layers = Vec::with_capacity(3);
        for (weight, bias) in &self.variables {
            layers.push(Layer::new(weight.flatten_all()?.to_vec1()?, bias.to_vec1()?)?);
        }
        ensure!(layers.len() == 3, "verifier layers: expected 3, got {}", layers.len());
        let layers: [Layer; 3] = layers.try_into().expect("three layers");
        Network::new(standardisation.clone(), layers)
    }
}

/// Binary cross-entropy of each logit z with its label y: softplus(z) - y z, with softplus(z) =
/// max(z, 0) + ln(1 + e^-|z|).
///
/// The logarithm of a sigmoid would become ln 0 in 32 bits for logits of about 17 and more.
/// candle's gradients of `relu` and `abs` at 0 are both 1, which together give the correct slope of
/// 1/2.
fn cross_entropy(logits: &Tensor, labels: &Tensor) -> candle_core::Result<Tensor> {
    let rest = (logits.abs()?.neg()?.exp()? + 1.0)?.log()?;
    (logits.relu()? + rest)? - (logits * labels)?
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use crate::weighted_loss;

    /// Compares value and slope of the loss at one logit with the formula in f64.
    fn check(logit: f32, label: f32) {
        let logits = Var::from_slice(&[logit], 1, &Device::Cpu).expect("a tensor");
        let labels = Tensor::new(&[label], &Device::Cpu).expect("a tensor");
        let loss = cross_entropy(&logits, &labels).expect("a loss");
        let slope = loss
            .backward()
            .expect("gradients")
            .get(&logits)
            .expect("its own")
            .to_vec1::<f32>()
            .expect("numbers")[0];
        let loss = loss.to_vec1::<f32>().expect("numbers")[0];

        let (z, y) = (f64::from(logit), f64::from(label));
        let expected = if y == 1.0 { (-z).exp().ln_1p() } else { z.exp().ln_1p() };
        let expected_slope = 1.0 / (1.0 + (-z).exp()) - y;
        let near = |found: f32, expected: f64| {
            (f64::from(found) - expected).abs() <= 2e-7 * expected.abs().max(1.0)
        };
        assert!(near(loss, expected), "loss at {logit}, {label}: expected {expected}, got {loss}");
        assert!(
            near(slope, expected_slope),
            "slope at {logit}, {label}: expected {expected_slope}, got {slope}"
        );
    }

    #[test]
    fn the_loss_and_its_slope_hold_for_any_logit() {
        for logit in
            [-100.0, -50.0, -17.0, -3.0, -0.5, -1e-6, 0.0, 1e-6, 0.5, 3.0, 17.0, 50.0, 100.0]
        {
            check(logit, 0.0);
            check(logit, 1.0);
        }
    }

    #[test]
    fn tensors_and_plain_loops_agree() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let rows: Vec<f32> = (0..40 * 6).map(|_| random.random_range(-3.0..5.0)).collect();
        let rows = || rows.chunks_exact(6);
        let labels: Vec<bool> = (0..40).map(|i| i % 3 == 0).collect();
        let standardisation = Standardisation::of(6, rows());
        let share = 14.0 / 40.0;
        let samples = Samples::new(&standardisation, rows(), &labels, share).expect("samples");
        let learner = Learner::new(6, [8, 5], &mut random).expect("a learner");
        let network = learner.network(&standardisation).expect("a network");
        let logits: Vec<f32> = rows().map(|row| network.logit(row)).collect();
        let in_tensors = learner
            .forward(&samples.hidden)
            .and_then(|logits| logits.to_vec1::<f32>())
            .expect("logits");
        for (plain, tensor) in logits.iter().zip(&in_tensors) {
            assert!((plain - tensor).abs() < 1e-5, "{plain} and {tensor}");
        }
        let all: Vec<u32> = (0..40).collect();
        let loss = learner
            .loss(&samples, &all)
            .and_then(|loss| Ok(loss.to_scalar::<f32>()?))
            .expect("a loss");
        let expected = weighted_loss(&logits, &labels, share).expect("samples");
        assert!((f64::from(loss) - expected).abs() < 1e-6, "{loss} and {expected}");
    }
}
