//! The verifier's network: standardisation, two hidden layers with ReLU, one logit.
//!
//! Plain loops in a fixed order take a few microseconds per row. A row's result does not depend on
//! the batch or on the number of threads.

use anyhow::ensure;

/// Maximum absolute value in a hidden state: the largest 16-bit float, because records store 16
/// bits.
const INPUT_MAX: f32 = 65_504.0;

/// Maximum sum that any hidden state may produce in an accepted network. Training produces at most
/// about 1e10; the largest f32 is 3e38.
const SUM_MAX: f64 = 1e30;

/// Mean and standard deviation of every input, measured on the training samples.
#[derive(Clone, Debug, PartialEq)]
pub struct Standardisation {
    /// Subtracted from the input.
    pub mean: Vec<f32>,
    /// Divides the difference; always above 0.
    pub deviation: Vec<f32>,
}

impl Standardisation {
    /// A feature with a smaller deviation counts as constant and is only shifted: dividing by it
    /// would amplify noise.
    const DEVIATION_MIN: f64 = 1e-6;

    /// Measures rows of `size` values.
    pub fn of<'a>(size: usize, rows: impl Iterator<Item = &'a [f32]> + Clone) -> Standardisation {
        let count = rows.clone().count().max(1) as f64;
        let mut mean = vec![0.0_f64; size];
        for row in rows.clone() {
            mean.iter_mut().zip(row).for_each(|(mean, value)| *mean += f64::from(*value) / count);
        }
        let mut variance = vec![0.0_f64; size];
        for row in rows {
            let differences = row.iter().zip(&mean).map(|(value, mean)| f64::from(*value) - mean);
            variance
                .iter_mut()
                .zip(differences)
                .for_each(|(variance, difference)| *variance += difference * difference / count);
        }
        let deviation = variance.into_iter().map(f64::sqrt);
        let deviation =
            deviation.map(|value| if value < Self::DEVIATION_MIN { 1.0 } else { value as f32 });
        Standardisation {
            deviation: deviation.collect(),
            mean: mean.into_iter().map(|value| value as f32).collect(),
        }
    }

    /// The standardised row.
    pub fn apply(&self, row: &[f32]) -> Vec<f32> {
        assert_eq!(row.len(), self.mean.len(), "the hidden state has the verifier's input size");
        let parts = row.iter().zip(&self.mean).zip(&self.deviation);
        parts.map(|((value, mean), deviation)| (value - mean) / deviation).collect()
    }
}

/// One affine layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// (outputs, inputs), row by row, as in the file.
    weight: Vec<f32>,
    /// (inputs, outputs): the inner loop runs over contiguous outputs.
    transposed: Vec<f32>,
    bias: Vec<f32>,
}

impl Layer {
    /// A layer from its weight (outputs, inputs) and bias (outputs).
    pub fn new(weight: Vec<f32>, bias: Vec<f32>) -> anyhow::Result<Layer> {
        let outputs = bias.len();
        ensure!(
            outputs > 0 && !weight.is_empty() && weight.len().is_multiple_of(outputs),
            "layer weight: expected a positive multiple of {outputs} outputs, got {} values",
            weight.len()
        );
        ensure!(
            weight.iter().chain(&bias).all(|value| value.is_finite()),
            "layer: expected finite values, got NaN or infinity"
        );
        let inputs = weight.len() / outputs;
        // (outputs, inputs) -> (inputs, outputs)
        let transposed = (0..inputs).flat_map(|i| (0..outputs).map(move |o| (i, o)));
        let transposed = transposed.map(|(i, o)| weight[o * inputs + i]).collect();
        Ok(Layer { transposed, weight, bias })
    }

    /// Length of the input vector.
    pub fn inputs(&self) -> usize {
        self.weight.len() / self.bias.len()
    }

    /// Length of the output vector.
    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// (outputs, inputs), row by row.
    pub fn weight(&self) -> &[f32] {
        &self.weight
    }

    /// One value per output.
    pub fn bias(&self) -> &[f32] {
        &self.bias
    }

    /// The maximum absolute value of each output for inputs within `bounds`.
    fn bounds(&self, bounds: &[f64]) -> Vec<f64> {
        let output = |(weights, bias): (&[f32], &f32)| {
            let products = weights.iter().zip(bounds);
            products.map(|(weight, bound)| f64::from(weight.abs()) * bound).sum::<f64>()
                + f64::from(bias.abs())
        };
        self.weight.chunks_exact(self.inputs()).zip(&self.bias).map(output).collect()
    }

    fn apply(&self, input: &[f32]) -> Vec<f32> {
        let mut output = self.bias.clone();
        for (value, weights) in input.iter().zip(self.transposed.chunks_exact(self.bias.len())) {
            output.iter_mut().zip(weights).for_each(|(output, weight)| *output += value * weight);
        }
        output
    }
}

/// The whole network; the sizes of its layers match.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    standardisation: Standardisation,
    layers: [Layer; 3],
}

impl Network {
    /// A network with two hidden layers and one output.
    pub fn new(standardisation: Standardisation, layers: [Layer; 3]) -> anyhow::Result<Network> {
        let size = standardisation.mean.len();
        let deviations = &standardisation.deviation;
        ensure!(
            deviations.len() == size
                && deviations.iter().all(|value| value.is_finite() && *value > 0.0),
            "standardisation: expected {size} finite deviations above 0, got {} values",
            deviations.len()
        );
        ensure!(
            standardisation.mean.iter().all(|value| value.is_finite()),
            "standardisation: expected finite means, got NaN or infinity"
        );
        let [first, second, last] = &layers;
        let sizes = [
            (first.inputs(), size),
            (second.inputs(), first.outputs()),
            (last.inputs(), second.outputs()),
            (last.outputs(), 1),
        ];
        for (found, expected) in sizes {
            ensure!(
                found == expected,
                "verifier layers: expected a size of {expected}, got {found}"
            );
        }
        let network = Network { standardisation, layers };
        let sum = network.sum_max();
        ensure!(
            sum <= SUM_MAX,
            "verifier network: expected sums of at most {SUM_MAX:e} for any 16-bit hidden state, got up to {sum:e}"
        );
        Ok(network)
    }

    /// Upper bound of the absolute value of any sum during the scoring of a hidden state of 16-bit
    /// floats. If it is finite, so is every logit.
    fn sum_max(&self) -> f64 {
        let Standardisation { mean, deviation } = &self.standardisation;
        let input = mean.iter().zip(deviation);
        let mut bounds: Vec<f64> = input
            .map(|(mean, deviation)| f64::from(INPUT_MAX + mean.abs()) / f64::from(*deviation))
            .collect();
        let mut largest = bounds.iter().copied().fold(0.0, f64::max);
        for layer in &self.layers {
            bounds = layer.bounds(&bounds);
            largest = bounds.iter().copied().fold(largest, f64::max);
        }
        largest
    }

    /// Length of a hidden state.
    pub fn input_size(&self) -> usize {
        self.standardisation.mean.len()
    }

    /// The standardisation of a hidden state before the first layer.
    pub fn standardisation(&self) -> &Standardisation {
        &self.standardisation
    }

    /// First hidden layer, second hidden layer, output.
    pub fn layers(&self) -> &[Layer; 3] {
        &self.layers
    }

    /// Checks that a hidden state has the right length and consists of 16-bit floats. NaN must be
    /// detected here, because the ReLU turns it into 0.
    pub fn check(&self, hidden: &[f32]) -> anyhow::Result<()> {
        let (expected, got) = (self.input_size(), hidden.len());
        ensure!(got == expected, "expected a hidden state of {expected} values, got {got}");
        let strange = hidden.iter().find(|value| value.is_nan() || value.abs() > INPUT_MAX);
        ensure!(
            strange.is_none(),
            "expected a hidden state of 16-bit floats, got {}",
            strange.copied().unwrap_or_default()
        );
        Ok(())
    }

    /// The logit of one hidden state.
    pub fn logit(&self, hidden: &[f32]) -> f32 {
        let [first, second, last] = &self.layers;
        let values = relu(first.apply(&self.standardisation.apply(hidden)));
        last.apply(&relu(second.apply(&values)))[0]
    }
}

fn relu(mut values: Vec<f32>) -> Vec<f32> {
    values.iter_mut().for_each(|value| *value = value.max(0.0));
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_network_equals_the_computation_by_hand() {
        let standardisation = Standardisation { mean: vec![1.0, 0.0], deviation: vec![2.0, 0.5] };
        let layers = [
            Layer::new(vec![1.0, 2.0, -1.0, 0.5], vec![0.0, 1.0]),
            Layer::new(vec![1.0, 1.0, -1.0, 0.0], vec![-1.0, 0.25]),
            Layer::new(vec![2.0, 3.0], vec![0.5]),
        ];
        let network = Network::new(standardisation, layers.map(|layer| layer.expect("whole")))
            .expect("fitting");
        // Standardised [1, 2]; first layer [5, 1]; second relu([5, -4.75]) = [5, 0];
        // output 2 * 5 + 0.5.
        assert_eq!(network.logit(&[3.0, 1.0]), 10.5);
        // Standardised [-1, -2]; first relu([-5, 1]) = [0, 1]; second relu([0, 0.25]);
        // output 3 * 0.25 + 0.5.
        assert_eq!(network.logit(&[-1.0, -1.0]), 1.25);
    }

    #[test]
    fn standardised_rows_have_mean_zero_and_deviation_one() {
        let rows = [[1.0, 5.0], [2.0, 5.0], [3.0, 5.0], [6.0, 5.0]];
        let standardisation = Standardisation::of(2, rows.iter().map(|row| row.as_slice()));
        assert_eq!(standardisation.mean, [3.0, 5.0]);
        assert!((standardisation.deviation[0] - 3.5_f32.sqrt()).abs() < 1e-6);
        // A constant feature is only shifted.
        assert_eq!(standardisation.apply(&[3.0, 6.0]), [0.0, 1.0]);
    }

    #[test]
    fn a_network_is_accepted_only_if_every_16_bit_hidden_state_has_a_finite_logit() {
        let network = |deviation: f32, weight: f32, bias: f32| {
            let standardisation = Standardisation { mean: vec![1.0], deviation: vec![deviation] };
            let layers = [vec![1.0], vec![1.0], vec![weight]];
            let layers = layers.map(|weight| Layer::new(weight, vec![bias]).expect("whole"));
            Network::new(standardisation, layers)
        };
        for (deviation, weight, bias) in [(1.0, 3e38, 0.0), (1.0, 1.0, 3e38), (1e-38, 1.0, 0.0)] {
            let error = network(deviation, weight, bias).expect_err("huge").to_string();
            let expected = "expected sums of at most 1e30 for any 16-bit hidden state, got up to ";
            assert!(error.contains(expected), "{error}");
        }
        let largest = network(1.0, 1e25, 0.0).expect("within the bound");
        let logits = [65_504.0, -65_504.0].map(|value| largest.logit(&[value]));
        assert!(logits.iter().all(|logit| logit.is_finite()), "{logits:?}");
        assert!((logits[0] - 65_503e25).abs() < 1e24, "{logits:?}");
    }

    #[test]
    fn layers_that_do_not_fit_are_refused() {
        let layer = |weights: usize, outputs: usize| {
            Layer::new(vec![0.5; weights], vec![0.0; outputs]).expect("whole")
        };
        let standardisation = || Standardisation { mean: vec![0.0; 2], deviation: vec![1.0; 2] };
        let fit = |layers| Network::new(standardisation(), layers);
        assert!(fit([layer(6, 3), layer(6, 2), layer(2, 1)]).is_ok());
        let error =
            fit([layer(6, 3), layer(8, 2), layer(2, 1)]).expect_err("4 inputs after 3 outputs");
        assert_eq!(error.to_string(), "verifier layers: expected a size of 3, got 4");
        assert!(fit([layer(9, 3), layer(6, 2), layer(2, 1)]).is_err());
        assert!(fit([layer(6, 3), layer(6, 2), layer(4, 2)]).is_err());
        assert!(Layer::new(vec![f32::NAN], vec![0.0]).is_err());
        assert!(Layer::new(vec![1.0; 3], vec![0.0; 2]).is_err());
        let flat = Standardisation { mean: vec![0.0; 2], deviation: vec![1.0, 0.0] };
        assert!(Network::new(flat, [layer(6, 3), layer(6, 2), layer(2, 1)]).is_err());
    }
}
