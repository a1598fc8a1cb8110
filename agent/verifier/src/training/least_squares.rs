//! Ridge regression by the normal equations.

/// The normal equations of a regression; their size does not depend on the number of samples.
pub struct NormalEquations {
    /// (terms, terms): mean products of the terms with each other.
    squares: Vec<Vec<f64>>,
    /// (terms): mean products of the terms with the target number.
    products: Vec<f64>,
}

/// Rounds of coordinate descent: far more than needed for so few weights, and still only
/// milliseconds.
const ROUNDS: usize = 1000;

impl NormalEquations {
    /// The equations of samples, each with its terms and its target number.
    pub fn of(terms: usize, samples: impl ExactSizeIterator<Item = (Vec<f64>, f64)>) -> Self {
        let count = samples.len().max(1) as f64;
        let (mut squares, mut products) = (vec![vec![0.0; terms]; terms], vec![0.0; terms]);
        for (row, number) in samples {
            for (left, squares) in row.iter().zip(&mut squares) {
                squares.iter_mut().zip(&row).for_each(|(sum, right)| *sum += left * right / count);
            }
            products.iter_mut().zip(&row).for_each(|(sum, term)| *sum += term * number / count);
        }
        NormalEquations { squares, products }
    }

    /// Penalises the weight of one term.
    pub fn add_ridge(&mut self, term: usize, ridge: f64) {
        self.squares[term][term] += ridge;
    }

    /// The weights with the least squared error plus ridge, by the Cholesky factors L L' of the
    /// squares.
    pub fn solve(&self) -> Vec<f64> {
        let terms = self.products.len();
        let mut lower = self.squares.clone();
        for column in 0..terms {
            for row in column..terms {
                let done: f64 = (0..column).map(|k| lower[row][k] * lower[column][k]).sum();
                let rest = lower[row][column] - done;
                lower[row][column] =
                    if row == column { rest.sqrt() } else { rest / lower[column][column] };
            }
        }
        let mut weights = self.products.clone();
        for row in 0..terms {
            let done: f64 = (0..row).map(|k| lower[row][k] * weights[k]).sum();
            weights[row] = (weights[row] - done) / lower[row][row];
        }
        for row in (0..terms).rev() {
            let done: f64 = (row + 1..terms).map(|k| lower[k][row] * weights[k]).sum();
            weights[row] = (weights[row] - done) / lower[row][row];
        }
        weights
    }

    /// The same with a sign constraint for every weight, by coordinate descent.
    pub fn solve_with_signs(&self, is_negative: impl Fn(usize) -> bool) -> Vec<f64> {
        let mut weights = vec![0.0; self.products.len()];
        for _ in 0..ROUNDS {
            for (index, squares) in self.squares.iter().enumerate() {
                let all: f64 = squares.iter().zip(&weights).map(|(one, weight)| one * weight).sum();
                let others = all - squares[index] * weights[index];
                let best = (self.products[index] - others) / squares[index];
                weights[index] = if is_negative(index) { best.min(0.0) } else { best.max(0.0) };
            }
        }
        weights
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// y = 3 a - 2 b + 0.5 at points that determine it.
    fn equations() -> NormalEquations {
        let points = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [2.0, 3.0], [-1.0, 1.0]];
        let samples = points.map(|[a, b]| (vec![1.0, a, b], 3.0 * a - 2.0 * b + 0.5));
        NormalEquations::of(3, samples.into_iter())
    }

    fn check(found: &[f64], expected: [f64; 3]) {
        let near = found.iter().zip(expected).all(|(found, one)| (found - one).abs() < 1e-9);
        assert!(near, "expected {expected:?}, got {found:?}");
    }

    #[test]
    fn a_linear_function_is_found() {
        check(&equations().solve(), [0.5, 3.0, -2.0]);
        check(&equations().solve_with_signs(|term| term == 2), [0.5, 3.0, -2.0]);
    }

    #[test]
    fn a_constrained_weight_is_0_and_the_others_are_optimal_without_it() {
        let weights = equations().solve_with_signs(|_| false);
        assert_eq!(weights[2], 0.0);
        // Without b: the regression of y on 1 and a, whose unconstrained solution has a negative
        // constant.
        assert_eq!(weights[0], 0.0);
        // Sums of a y and of a a over the points: 3.5 + 1.0 + 4.5 and 1 + 4 + 1.
        check(&weights, [0.0, 9.0 / 6.0, 0.0]);
    }

    #[test]
    fn ridge_draws_a_weight_towards_0() {
        let mut one = NormalEquations::of(1, [(vec![2.0], 6.0)].into_iter());
        assert_eq!(one.solve(), [3.0]);
        one.add_ridge(0, 4.0);
        assert!((one.solve()[0] - 1.5).abs() < 1e-12);
    }
}
