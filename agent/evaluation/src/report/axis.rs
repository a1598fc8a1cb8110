//! A linear axis: from values to places in a figure, with ticks at round numbers.

/// Values `low..=high` along pixels `from..=to` (which may run either way).
#[derive(Clone, Copy)]
pub struct Axis {
    pub low: f64,
    pub high: f64,
    pub from: f64,
    pub to: f64,
}

impl Axis {
    /// The place of a value; values beyond the ends are drawn at the ends.
    pub fn at(&self, value: f64) -> f64 {
        let share = ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0);
        self.from + share * (self.to - self.from)
    }

    /// Round values inside the axis, about `count` of them.
    pub fn ticks(&self, count: usize) -> Vec<f64> {
        let step = round_step((self.high - self.low) / count.max(1) as f64);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step + 1e-9).floor() as i64;
        (first..=last).map(|index| index as f64 * step).collect()
    }
}

/// The smallest of 1, 2, 5 times a power of ten that is at least `rough`.
fn round_step(rough: f64) -> f64 {
    let power = 10f64.powf(rough.log10().floor());
    let factor =
        [1.0, 2.0, 5.0, 10.0].into_iter().find(|factor| factor * power >= rough * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_fall_on_their_places() {
        let axis = Axis { low: -10.0, high: 30.0, from: 100.0, to: 500.0 };
        assert_eq!(axis.at(-10.0), 100.0);
        assert_eq!(axis.at(0.0), 200.0);
        assert_eq!(axis.at(99.0), 500.0);
        assert_eq!(axis.ticks(4), [-10.0, 0.0, 10.0, 20.0, 30.0]);
        assert_eq!(Axis { low: 0.0, high: 1.0, ..axis }.ticks(5).len(), 6);
    }
}
