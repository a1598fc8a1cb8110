//! A setting: how the candidates of an episode are sampled and how one of them is selected.

use std::fmt;

use crate::Strategy;

/// How the candidates of an episode are sampled and selected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setting {
    /// How a candidate is selected.
    pub strategy: Strategy,
    /// Candidates per decision.
    pub candidates: u32,
    /// Sampling temperature.
    pub temperature: f32,
}

impl Setting {
    /// Normalises a setting: greedy implies temperature 0, and N = 1 implies a single sample.
    pub fn new(strategy: Strategy, candidates: u32, temperature: f32) -> Setting {
        let drawn = strategy.candidates(candidates as usize) as u32;
        let strategy =
            if drawn == 1 && strategy != Strategy::Greedy { Strategy::Sample } else { strategy };
        Setting { strategy, candidates: drawn, temperature: strategy.temperature(temperature) }
    }

    /// All distinct settings of the given strategies, temperatures and numbers of candidates, in
    /// that order.
    pub fn all(strategies: &[Strategy], temperatures: &[f32], candidates: &[u32]) -> Vec<Setting> {
        let mut settings: Vec<Setting> = Vec::new();
        for strategy in strategies {
            for temperature in temperatures {
                for count in candidates {
                    let setting = Setting::new(*strategy, *count, *temperature);
                    if !settings.contains(&setting) {
                        settings.push(setting);
                    }
                }
            }
        }
        settings
    }
}

impl fmt::Display for Setting {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.strategy {
            Strategy::Greedy => write!(formatter, "greedy"),
            Strategy::Sample if self.candidates == 1 => {
                write!(formatter, "sample T={}", self.temperature)
            }
            strategy => {
                write!(formatter, "{strategy} N={} T={}", self.candidates, self.temperature)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_settings_are_run_once() {
        let settings = Setting::all(
            &[Strategy::Greedy, Strategy::Sample, Strategy::Verifier],
            &[1.0, 0.7],
            &[1, 2, 5],
        );
        let drawn = Setting { strategy: Strategy::Sample, candidates: 5, temperature: 1.0 };
        assert_eq!(drawn.to_string(), "sample N=5 T=1", "as collected, to be compared");
        let names: Vec<String> = settings.iter().map(Setting::to_string).collect();
        let expected = [
            "greedy",
            "sample T=1",
            "sample T=0.7",
            "verifier N=2 T=1",
            "verifier N=5 T=1",
            "verifier N=2 T=0.7",
            "verifier N=5 T=0.7",
        ];
        assert_eq!(names, expected);
    }
}
