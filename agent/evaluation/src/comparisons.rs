//! Comparisons: gains between settings on the same episodes, and the share of the gap to the oracle that each closes.

use decision::{Setting, Strategy};

use crate::counted::{SettingEpisodes, in_common};
use crate::estimate::{self, Gain, Headroom};

/// The default setting of the program: the subject of a run's headline.
pub const DEFAULT_SETTING: Setting =
    Setting { strategy: Strategy::Verifier, candidates: 5, temperature: 1.0 };

/// The gain of one setting over another on the episodes that both have in common.
#[derive(Debug, Clone, PartialEq)]
pub struct SettingGain {
    /// The setting under test.
    pub better: Setting,
    /// The setting that it is compared with.
    pub worse: Setting,
    /// Difference in success at the last step.
    pub gain: Gain,
}

/// The share of the gap between a single sample and the oracle that a setting closes. All three have the same
/// temperature; setting and oracle have the same number of candidates.
#[derive(Debug, Clone, PartialEq)]
pub struct SettingHeadroom {
    /// The setting under test.
    pub setting: Setting,
    /// The share, on the episodes that all three have in common.
    pub headroom: Headroom,
}

/// The gains of `verifier` and `verifier+medoid` over all other strategies but the oracle, of `verifier+medoid` over
/// `verifier`, and of `first-well-formed` over `sample`: the gain from discarding malformed candidates alone.
pub fn gains(settings: &[SettingEpisodes<'_>]) -> Vec<SettingGain> {
    let mut gains = Vec::new();
    for better in settings {
        for worse in settings.iter().filter(|worse| is_compared(better.setting, worse.setting)) {
            let [ours, theirs] = in_common([better, worse]);
            if let Some(gain) = estimate::gain(&ours, &theirs) {
                gains.push(SettingGain { better: better.setting, worse: worse.setting, gain });
            }
        }
    }
    gains
}

fn is_compared(better: Setting, worse: Setting) -> bool {
    let is_verifier = matches!(better.strategy, Strategy::Verifier | Strategy::VerifierMedoid);
    let is_as_hot = worse.temperature == better.temperature;
    let is_as_many = is_as_hot && worse.candidates == better.candidates;
    match worse.strategy {
        Strategy::Greedy => is_verifier,
        Strategy::Sample => {
            is_as_hot && (is_verifier || better.strategy == Strategy::FirstWellFormed)
        }
        Strategy::FirstWellFormed | Strategy::Majority | Strategy::Medoid | Strategy::Worst => {
            is_as_many && is_verifier
        }
        Strategy::Verifier => is_as_many && better.strategy == Strategy::VerifierMedoid,
        Strategy::VerifierMedoid | Strategy::Oracle => false,
    }
}

/// The headroom of every setting that chooses among candidates, if the run has a single sample and the oracle.
pub fn headroom(settings: &[SettingEpisodes<'_>]) -> Vec<SettingHeadroom> {
    let find = |strategy: Strategy, candidates: u32, temperature: f32| {
        let wanted = Setting { strategy, candidates, temperature };
        settings.iter().find(|one| one.setting == wanted)
    };
    let of_setting = |chosen: &SettingEpisodes<'_>| {
        let setting = chosen.setting;
        if matches!(setting.strategy, Strategy::Greedy | Strategy::Sample | Strategy::Oracle) {
            return None;
        }
        let sample = find(Strategy::Sample, 1, setting.temperature)?;
        let oracle = find(Strategy::Oracle, setting.candidates, setting.temperature)?;
        let [sample, chosen, oracle] = in_common([sample, chosen, oracle]);
        let headroom = estimate::headroom(&sample, &chosen, &oracle)?;
        Some(SettingHeadroom { setting, headroom })
    };
    settings.iter().filter_map(of_setting).collect()
}

/// The comparison of a run's headline: the verifier against a single sample, with the number of candidates and the
/// temperature that are nearest to the defaults.
pub fn main_gain(gains: &[SettingGain]) -> Option<&SettingGain> {
    let is_main = |gain: &&SettingGain| {
        gain.better.strategy == DEFAULT_SETTING.strategy && gain.worse.strategy == Strategy::Sample
    };
    let distance = |gain: &&SettingGain| {
        let Setting { candidates, temperature, .. } = gain.better;
        let colder = (temperature - DEFAULT_SETTING.temperature).abs();
        (candidates.abs_diff(DEFAULT_SETTING.candidates), (colder * 1e3) as u32)
    };
    gains.iter().filter(is_main).min_by_key(distance)
}
