//! Times single decisions: prefill, decode, parse, score, choose.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use decision::{
    Decider, DecisionRequest, EpisodeContext, Observation, Policy, ProposalRequest, Scorer,
    Setting as EpisodeSetting, Strategy,
};
use evaluation::statistics::quantile;
use serde::Serialize;
use verifier::Verifier;
use vla::Vla;

use super::bandwidth;
use super::torch::{Hello, Torch};

/// Numbers of candidates that are timed.
const CANDIDATES: [usize; 5] = [1, 2, 5, 8, 16];
/// The number of candidates that ratios refer to: the default of every command.
const CANDIDATES_DEFAULT: usize = 5;
/// Rounds that are not counted, while caches fill and compilers compile.
const WARM_UP_ROUNDS: usize = 1;

/// How candidates are sampled.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Setting {
    /// Candidates per decision.
    pub candidates: usize,
    /// 0 for greedy decoding, else 1.
    pub temperature: f32,
}

/// The results for one setting.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// The setting.
    #[serde(flatten)]
    pub setting: Setting,
    /// What only a local checkpoint has.
    #[serde(flatten)]
    pub network: Option<NetworkRow>,
    /// Tokens of all candidates of a decision, mean.
    pub tokens: f64,
    /// Time of a decision (prefill, decode, parse, score, choose), median.
    pub decision_ms_p50: f64,
    /// The same, 95th percentile.
    pub decision_ms_p95: f64,
    /// Tokens of all candidates divided by the time of the whole decision.
    pub tokens_per_second: f64,
}

/// The times of the network in one setting.
#[derive(Debug, Clone, Serialize)]
pub struct NetworkRow {
    /// Time of prefill (image and prompt): the fastest observation.
    pub prefill_ms: f64,
    /// Time of a decoding step, one token of every candidate: the fastest observation.
    pub step_ms: f64,
    /// Bytes of weights that a step reads.
    pub weight_bytes: usize,
    /// Bandwidth of a step, as a share of that at which this machine reads a buffer of the same size.
    pub bandwidth_share: f64,
}

/// The same decisions in PyTorch, without parsing, scoring and choosing.
#[derive(Debug, Clone, Serialize)]
pub struct Comparison {
    /// How PyTorch runs the network: eager, compiled, ….
    pub setting: String,
    /// Candidates per decision.
    pub candidates: usize,
    /// Time of prefill and decode, median.
    pub decision_ms_p50: f64,
    /// The same, 95th percentile.
    pub decision_ms_p95: f64,
}

/// The results of one benchmark.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The results of rever, one row per setting; the first is greedy, unless the policy cannot decode greedily.
    pub rows: Vec<Row>,
    /// Bandwidth at which all threads read a buffer as large as a step's weights, at most 1 GiB; of a
    /// local checkpoint.
    pub bandwidth_bytes_per_second: Option<f64>,
    /// The strategy that compares the candidates: `verifier`, or `medoid` without a verifier.
    pub strategy: String,
    /// Median time of five compared candidates divided by that of one greedy candidate.
    pub ratio_greedy: Option<f64>,
    /// Time of eager PyTorch divided by that of rever, at five candidates; only with a comparison.
    pub ratio_eager: Option<f64>,
    /// The same for the fastest PyTorch setting.
    pub ratio_best: Option<f64>,
    /// The results of PyTorch.
    pub torch: Vec<Comparison>,
    /// PyTorch's version and settings.
    pub torch_hello: Option<Hello>,
    /// Threads of rever.
    pub threads: usize,
    /// Decisions behind every median.
    pub decisions: usize,
    /// Digest of the policy.
    pub policy: String,
    /// Digest of the verifier, if there is one.
    pub verifier: Option<String>,
}

/// The parameters of the benchmark.
pub struct DecisionBench<'a> {
    /// The policy that proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// The same policy, if it is a local checkpoint: its prefill and steps are timed, too.
    pub checkpoint: Option<Arc<Vla>>,
    /// The verifier that scores them, if there is one; without it the medoid is executed.
    pub verifier: Option<Arc<Verifier>>,
    /// The observations to decide on, one after the other.
    pub observations: &'a [Observation],
    /// Counted passes over all observations.
    pub rounds: usize,
    /// Drives the decider; the policy computes in the calling thread.
    pub runtime: &'a tokio::runtime::Runtime,
}

impl DecisionBench<'_> {
    /// Measures every setting of rever and of PyTorch, alternately.
    pub fn run(&self, mut torch: Option<Torch>, mut progress: impl FnMut(usize)) -> Result<Report> {
        ensure!(self.rounds > 0, "rounds: expected at least 1, got 0");
        let settings = self.settings();
        let decider = Decider::new(Arc::clone(&self.policy));
        let hello = torch.as_ref().map(|torch| torch.hello.clone());
        let torch_settings = hello.as_ref().map(|hello| hello.settings.clone()).unwrap_or_default();
        let mut ours: Vec<Samples> = settings.iter().map(|_| Samples::default()).collect();
        let mut theirs: Vec<Vec<Vec<f64>>> =
            vec![vec![Vec::new(); settings.len()]; torch_settings.len()];
        for round in 0..WARM_UP_ROUNDS + self.rounds {
            progress(round);
            let is_counted = round >= WARM_UP_ROUNDS;
            for (index, observation) in self.observations.iter().enumerate() {
                for (which, setting) in settings.iter().enumerate() {
                    let (ms, tokens) =
                        self.decide(&decider, observation, *setting, round as u64)?;
                    if is_counted {
                        ours[which].add(ms, tokens.iter().map(Vec::len).sum());
                    }
                    let Some(torch) = torch.as_mut().filter(|_| setting.temperature > 0.0) else {
                        continue;
                    };
                    for (name, times) in torch_settings.iter().zip(&mut theirs) {
                        let ms = torch.decide(name, index, &tokens)?;
                        if is_counted {
                            times[which].push(ms);
                        }
                    }
                }
            }
        }
        let comparisons = torch_settings.iter().zip(theirs).flat_map(|(name, times)| {
            settings.iter().zip(times).filter(|(_, times)| !times.is_empty()).map(
                |(setting, mut times)| {
                    times.sort_by(f64::total_cmp);
                    Comparison {
                        setting: name.clone(),
                        candidates: setting.candidates,
                        decision_ms_p50: quantile(&times, 0.5),
                        decision_ms_p95: quantile(&times, 0.95),
                    }
                },
            )
        });
        self.report(&settings, ours, comparisons.collect(), hello)
    }

    /// The greedy setting first, if the policy has one, then the sampled ones.
    fn settings(&self) -> Vec<Setting> {
        let greedy = self.policy.check(&EpisodeSetting::new(Strategy::Greedy, 1, 0.0)).is_ok();
        greedy.then_some(GREEDY).into_iter().chain(CANDIDATES.map(sampled)).collect()
    }

    /// The milliseconds of one decision, and the tokens of every candidate.
    fn decide(
        &self,
        decider: &Decider,
        observation: &Observation,
        setting: Setting,
        seed: u64,
    ) -> Result<(f64, Vec<Vec<u32>>)> {
        let scorer = self.verifier.clone().map(|verifier| verifier as Arc<dyn Scorer>);
        let (strategy, scorer) = match setting.temperature {
            // Greedy decoding does not use the verifier.
            0.0 => (Strategy::Greedy, None),
            _ => (compared(scorer.is_some()), scorer),
        };
        let Setting { candidates, temperature } = setting;
        let setting = EpisodeSetting { strategy, candidates: candidates as u32, temperature };
        let start = Instant::now();
        let instruction = observation.instruction.clone();
        // Without a well-formed candidate the decision is to hold still.
        let action = self.policy.info().action_space.dimensions();
        let mut context = EpisodeContext::new(setting, seed, instruction, scorer, &action);
        let request = DecisionRequest { observation, context: &mut context };
        let decided = self.runtime.block_on(decider.decide(vec![request]));
        let decision = decided.into_iter().next().context("no decision")??;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        Ok((ms, decision.candidates.into_iter().map(|candidate| candidate.tokens).collect()))
    }

    fn report(
        &self,
        settings: &[Setting],
        samples: Vec<Samples>,
        torch: Vec<Comparison>,
        torch_hello: Option<Hello>,
    ) -> Result<Report> {
        let checkpoint = self.checkpoint.as_ref();
        let bandwidth = checkpoint.map(|policy| bandwidth::measure(policy.step_bytes()));
        let rows = settings.iter().zip(samples);
        let rows = rows.map(|(setting, samples)| self.row(*setting, samples, bandwidth));
        let rows = rows.collect::<Result<Vec<Row>>>()?;
        let verified = rows.iter().find(|row| row.setting == sampled(CANDIDATES_DEFAULT));
        let verified = verified.context("five candidates are always timed")?.decision_ms_p50;
        let greedy = rows.iter().find(|row| row.setting == GREEDY);
        let of_torch = |setting: Option<&str>| {
            torch
                .iter()
                .filter(|one| one.candidates == CANDIDATES_DEFAULT)
                .filter(|one| setting.is_none_or(|setting| setting == one.setting))
                .map(|one| one.decision_ms_p50 / verified)
                .min_by(f64::total_cmp)
        };
        let eager = torch_hello.as_ref().and_then(|hello| hello.settings.first());
        Ok(Report {
            ratio_greedy: greedy.map(|row| verified / row.decision_ms_p50),
            ratio_eager: eager.and_then(|setting| of_torch(Some(setting))),
            ratio_best: of_torch(None),
            bandwidth_bytes_per_second: bandwidth,
            torch,
            torch_hello,
            threads: rayon::current_num_threads(),
            decisions: self.rounds * self.observations.len(),
            strategy: compared(self.verifier.is_some()).to_string(),
            policy: self.policy.info().digest.clone(),
            verifier: self.verifier.as_ref().map(|verifier| verifier.digest().to_owned()),
            rows,
        })
    }

    fn row(&self, setting: Setting, mut samples: Samples, bandwidth: Option<f64>) -> Result<Row> {
        samples.ms.sort_by(f64::total_cmp);
        let Samples { ms, tokens } = samples;
        let seconds = ms.iter().sum::<f64>() / 1e3;
        let tokens_mean = tokens as f64 / ms.len() as f64;
        let steps = (tokens_mean / setting.candidates as f64).round() as usize;
        let network = self.checkpoint.as_ref().zip(bandwidth).map(|(checkpoint, bandwidth)| {
            self.network_row(checkpoint, setting, steps.max(1), bandwidth)
        });
        Ok(Row {
            setting,
            network: network.transpose()?,
            tokens: tokens_mean,
            decision_ms_p50: quantile(&ms, 0.5),
            decision_ms_p95: quantile(&ms, 0.95),
            tokens_per_second: tokens as f64 / seconds,
        })
    }

    fn network_row(
        &self,
        checkpoint: &Vla,
        setting: Setting,
        steps: usize,
        bandwidth: f64,
    ) -> Result<NetworkRow> {
        let Setting { candidates, temperature } = setting;
        let (mut prefill_ms, mut step_ms) = (f64::INFINITY, f64::INFINITY);
        for Observation { image, instruction, state, .. } in self.observations {
            let request = ProposalRequest {
                image,
                state,
                instruction,
                candidates,
                temperature,
                seed: 0,
                episode: None,
            };
            let timings = checkpoint.time(&[request], steps)?;
            prefill_ms = prefill_ms.min(timings.prefill_ms);
            step_ms = step_ms.min(timings.step_ms);
        }
        let weight_bytes = checkpoint.step_bytes();
        Ok(NetworkRow {
            prefill_ms,
            step_ms,
            weight_bytes,
            bandwidth_share: weight_bytes as f64 / (step_ms / 1e3) / bandwidth,
        })
    }
}

/// Times and tokens of one setting's decisions.
#[derive(Debug, Default)]
struct Samples {
    ms: Vec<f64>,
    tokens: usize,
}

impl Samples {
    fn add(&mut self, ms: f64, tokens: usize) {
        self.ms.push(ms);
        self.tokens += tokens;
    }
}

/// The strategy that compares candidates: the verifier's, or the medoid, which needs none.
pub fn compared(has_verifier: bool) -> Strategy {
    if has_verifier { Strategy::Verifier } else { Strategy::Medoid }
}

const GREEDY: Setting = Setting { candidates: 1, temperature: 0.0 };

fn sampled(candidates: usize) -> Setting {
    Setting { candidates, temperature: 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::read_observations;
    use std::path::Path;
    use vla::{DeviceName, LoadOptions};

    #[test]
    fn every_setting_is_timed_on_every_observation() {
        let agent = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a folder");
        let model = agent.join("models/bridge-small");
        let policy = Vla::load(&model, DeviceName::Cpu, &LoadOptions::default())
            .expect("the shipped policy");
        let file = model.join(crate::files::VERIFIER_FILE);
        let digest = policy.parser().digest();
        let verifier = Verifier::load(&file, digest).expect("the shipped verifier");
        let observations =
            read_observations(&agent.join("vla/tests/fixtures/bridge-small.safetensors"));
        let observations = &observations.expect("recorded ones")[..2];
        let runtime = tokio::runtime::Runtime::new().expect("a runtime");
        let policy = Arc::new(policy);
        let bench = DecisionBench {
            policy: Arc::clone(&policy) as Arc<dyn Policy>,
            checkpoint: Some(policy),
            verifier: Some(Arc::new(verifier)),
            observations,
            rounds: 1,
            runtime: &runtime,
        };
        let report = bench.run(None, |_| ()).expect("a report");
        let settings: Vec<Setting> = report.rows.iter().map(|row| row.setting).collect();
        assert_eq!(settings, bench.settings());
        assert_eq!(settings[0], GREEDY);
        assert_eq!(report.decisions, 2);
        for row in &report.rows {
            assert!(0.0 < row.decision_ms_p50 && row.decision_ms_p50 <= row.decision_ms_p95);
            // A candidate has 17 tokens of reasoning and 7 of action. A malformed one may have fewer or more.
            let each = row.tokens / row.setting.candidates as f64;
            assert!((18.0..=30.0).contains(&each), "{row:?}");
        }
        let p50 = |setting: Setting| {
            report.rows.iter().find(|row| row.setting == setting).expect("timed").decision_ms_p50
        };
        assert_eq!(report.ratio_greedy, Some(p50(sampled(5)) / p50(GREEDY)));
        assert_eq!((report.ratio_eager, report.ratio_best), (None, None));
    }
}
