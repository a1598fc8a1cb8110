//! Tests of intervals: published values, exact values, and coverage in simulations with fixed seeds.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// One episode per start.
fn single(outcomes: impl IntoIterator<Item = bool>) -> TaskClusters {
    outcomes
        .into_iter()
        .map(|success| Cluster { mean: f64::from(u8::from(success)), episodes: 1.0 })
        .collect()
}

/// `successes` of `episodes`, one episode per start.
fn successes(successes: usize, episodes: usize) -> TaskClusters {
    single((0..episodes).map(|index| index < successes))
}

/// Numbers of pairs in which both succeed, only the first, only the second, neither.
fn pairs(cells: [usize; 4]) -> (TaskClusters, TaskClusters) {
    let kinds = [(true, true), (true, false), (false, true), (false, false)];
    let all = || kinds.iter().zip(cells).flat_map(|(kind, count)| std::iter::repeat_n(kind, count));
    (single(all().map(|pair| pair.0)), single(all().map(|pair| pair.1)))
}

fn near(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() < tolerance, "expected {expected}, got {found}");
}

#[test]
fn one_task_of_single_episodes_has_wilsons_interval() {
    for (count, of) in [(0, 4), (3, 4), (4, 4), (17, 24), (24, 24)] {
        let rate = Rate::over_tasks(&[successes(count, of)]);
        let expected = wilson(count as f64 / of as f64, of as f64);
        near(rate.interval.low, expected.low, 1e-12);
        near(rate.interval.high, expected.high, 1e-12);
        assert_eq!((rate.episodes, rate.starts), (of as u64, of as u64));
    }
}

#[test]
fn every_task_counts_the_same_however_many_episodes_it_has() {
    let rate = Rate::over_tasks(&[successes(10, 10), successes(0, 40)]);
    assert_eq!((rate.value, rate.episodes), (Some(0.5), 50));
    let none = Rate::over_tasks(&[successes(10, 10), Vec::new()]);
    assert_eq!((none.value, none.interval, none.episodes), (None, Interval::UNKNOWN, 10));
}

#[test]
fn a_gain_of_one_task_has_newcombes_published_interval() {
    // Newcombe (1998), table II, method 10.
    let (one, other) = pairs([36, 12, 2, 0]);
    let gain = gain(&[one], &[other]).expect("pairs");
    near(gain.mean, 0.2, 1e-12);
    near(gain.interval.low, 0.0569, 5e-5);
    near(gain.interval.high, 0.3404, 5e-5);
    // Fagerland, Lydersen and Laake, "Recommended tests and confidence intervals for paired binomial proportions",
    // Statistics in Medicine 33 (2014): airway hyper-responsiveness.
    let (one, other) = pairs([1, 1, 7, 12]);
    let gain = super::gain(&[one], &[other]).expect("pairs");
    near(gain.interval.low, -0.507, 5e-4);
    near(gain.interval.high, -0.026, 5e-4);
    assert_eq!((gain.pairs, gain.starts), (21, 21));
}

#[test]
fn no_interval_is_without_width_even_where_all_pairs_agree() {
    for tasks in [1, 4] {
        for count in [1, 2, 4, 24, 100] {
            for cells in
                [[count, 0, 0, 0], [0, count, 0, 0], [0, 0, 0, count], [count, 0, 0, count]]
            {
                let (one, other) = pairs(cells);
                let gain = gain(&vec![one; tasks], &vec![other; tasks]).expect("pairs");
                let width = gain.interval.high - gain.interval.low;
                let episodes = (count * tasks) as f64;
                assert!(width > 0.5 / episodes, "{cells:?} in {tasks} tasks: {gain:?}");
                assert!(gain.interval.contains(gain.mean), "{gain:?}");
            }
        }
    }
}

#[test]
fn a_single_pair_per_task_decides_nothing_that_half_the_tasks_contradict() {
    // `rever demo --episodes 1`: the verifier wins on two tasks of four and ties on two. The interval once had zero
    // width: +50.0 [+50.0, +50.0].
    let (win, tie) = (pairs([0, 1, 0, 0]), pairs([1, 0, 0, 0]));
    let better = [win.0.clone(), win.0, tie.0.clone(), tie.0];
    let worse = [win.1.clone(), win.1, tie.1.clone(), tie.1];
    let gain = gain(&better, &worse).expect("pairs");
    assert_eq!((gain.mean, gain.better_rate, gain.worse_rate, gain.pairs), (0.5, 1.0, 0.5, 4));
    assert!(gain.interval.contains(0.0), "{gain:?}");
    assert_eq!(super::gain(&better[..1], &[Vec::new()]), None, "a task without pairs");
}

#[test]
fn repeats_of_one_start_say_less_than_starts_would() {
    let cluster = |mean| Cluster { mean, episodes: 3.0 };
    let interval = |means: [f64; 8]| Rate::over_tasks(&[means.map(cluster).to_vec()]).interval;
    // All episodes of a start have the same outcome: the interval is that of 4 of 8.
    let alike = interval([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    near(alike.low, wilson(0.5, 8.0).low, 1e-12);
    // Episodes vary within a start as much as overall: the interval is that of 12 of 24.
    let third = 1.0 / 3.0;
    let different =
        interval([third, third, third, third, 2.0 * third, 2.0 * third, 2.0 * third, 2.0 * third]);
    near(different.low, wilson(0.5, 24.0).low, 1e-12);
    // If all succeed, the correlation is unknown: the interval is that of 8 of 8.
    near(interval([1.0; 8]).low, wilson(1.0, 8.0).low, 1e-12);
}

#[test]
fn headroom_is_the_share_of_the_gap_to_the_oracle_with_an_interval() {
    let of = |count| vec![successes(count, 24); 4];
    let half = headroom(&of(6), &of(12), &of(18)).expect("headroom");
    near(half.fraction, 0.5, 1e-12);
    let interval = half.interval.expect("ends");
    assert!(0.1 < interval.low && interval.low < 0.5, "{half:?}");
    assert!(0.5 < interval.high && interval.high < 0.9, "{half:?}");
    // The end of the interval is the last ratio that is not rejected.
    let rest = remainder(&of(6), &of(12), &of(18), interval.high).expect("an interval");
    near(rest.high.abs().min(rest.low.abs()), 0.0, 1e-9);
    let worse = headroom(&of(12), &of(6), &of(18)).expect("headroom");
    near(worse.fraction, -1.0, 1e-12);
    assert!(worse.interval.expect("ends").high < 0.0, "{worse:?}");
    let few = |count| vec![successes(count, 2); 2];
    let unclear = headroom(&few(1), &few(1), &few(2)).expect("headroom");
    assert_eq!((unclear.fraction, unclear.interval), (0.0, None), "the oracle may be no better");
    assert_eq!(headroom(&of(6), &of(8), &of(6)), None, "there is no gap");
}

/// A simulated run: tasks, starts, episodes per start, rates of settings, and the correlation of episodes.
struct Simulation {
    tasks: usize,
    starts: usize,
    repeats: usize,
    /// True rate of each setting, the same on all tasks.
    rates: Vec<f64>,
    /// Probability that a setting uses the number that an episode draws for all settings, so that pairs agree.
    agreement: f64,
    /// Probability that a start draws one number for all its episodes, so that they are a cluster.
    likeness: f64,
}

impl Simulation {
    /// The outcomes of one run: for each setting, the clusters of each task.
    fn run(&self, random: &mut ChaCha8Rng) -> Vec<Vec<TaskClusters>> {
        let mut settings = vec![vec![Vec::new(); self.tasks]; self.rates.len()];
        for task in 0..self.tasks {
            for _ in 0..self.starts {
                let of_start: f64 = random.random();
                let is_alike = random.random_bool(self.likeness);
                let mut counts = vec![0.0; self.rates.len()];
                for _ in 0..self.repeats {
                    let shared = if is_alike { of_start } else { random.random() };
                    for (count, rate) in counts.iter_mut().zip(&self.rates) {
                        let agrees = is_alike || random.random_bool(self.agreement);
                        let number = if agrees { shared } else { random.random() };
                        *count += f64::from(u8::from(number < *rate));
                    }
                }
                for (setting, count) in settings.iter_mut().zip(counts) {
                    let episodes = self.repeats as f64;
                    setting[task].push(Cluster { mean: count / episodes, episodes });
                }
            }
        }
        settings
    }

    /// The share of runs for which `holds` is true.
    fn share(&self, seed: u64, holds: impl Fn(&[Vec<TaskClusters>]) -> bool) -> f64 {
        const RUNS: u32 = 2000;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let held = (0..RUNS).filter(|_| holds(&self.run(&mut random))).count();
        held as f64 / f64::from(RUNS)
    }
}

/// All simulations with 1 or 4 tasks, 4 to 24 starts each, and the given rates.
fn small_simulations(rates: &[&[f64]]) -> Vec<Simulation> {
    let mut simulations = Vec::new();
    for tasks in [1, 4] {
        for starts in [4, 6, 12, 24] {
            for rates in rates {
                for agreement in [0.0, 0.6, 0.9] {
                    let rates = rates.to_vec();
                    simulations.push(Simulation {
                        tasks,
                        starts,
                        repeats: 1,
                        rates,
                        agreement,
                        likeness: 0.0,
                    });
                }
            }
        }
    }
    simulations
}

fn mean_of(shares: &[f64]) -> f64 {
    shares.iter().sum::<f64>() / shares.len() as f64
}

#[test]
fn intervals_of_rates_hold_the_truth_in_95_of_100_runs() {
    let simulations = small_simulations(&[&[0.5], &[0.7], &[0.9], &[0.1]]);
    let shares: Vec<f64> = simulations
        .iter()
        .map(|simulation| {
            simulation
                .share(1, |run| Rate::over_tasks(&run[0]).interval.contains(simulation.rates[0]))
        })
        .collect();
    let least = shares.iter().copied().fold(1.0, f64::min);
    // Wilson's interval of four trials contains one half in 14 of 16 cases: those with one to three successes.
    assert!(least > 0.86, "{least}: {shares:?}");
    assert!((0.94..0.975).contains(&mean_of(&shares)), "{}: {shares:?}", mean_of(&shares));
}

#[test]
fn intervals_of_gains_hold_the_truth_in_95_of_100_runs() {
    let simulations = small_simulations(&[&[0.5, 0.5], &[0.9, 0.7], &[0.3, 0.1], &[0.7, 0.5]]);
    let shares: Vec<f64> = simulations
        .iter()
        .map(|simulation| {
            let truth = simulation.rates[0] - simulation.rates[1];
            simulation.share(2, |run| {
                let gain = gain(&run[0], &run[1]).expect("pairs");
                // A difference of two rates may differ from the truth in its last bit.
                gain.interval.low - 1e-9 <= truth && truth <= gain.interval.high + 1e-9
            })
        })
        .collect();
    let least = shares.iter().copied().fold(1.0, f64::min);
    assert!(least > 0.915, "{least}: {shares:?}");
    assert!(mean_of(&shares) < 0.985, "not much too wide: {}", mean_of(&shares));
}

#[test]
fn intervals_of_headroom_hold_the_truth_in_95_of_100_runs() {
    for starts in [6, 24] {
        for agreement in [0.0, 0.7] {
            let rates = vec![0.5, 0.7, 0.9];
            let simulation =
                Simulation { tasks: 4, starts, repeats: 1, rates, agreement, likeness: 0.0 };
            let wrong = simulation.share(3, |run| {
                let found = headroom(&run[0], &run[1], &run[2]).and_then(|found| found.interval);
                found.is_some_and(|interval| !interval.contains(0.5))
            });
            assert!(wrong < 0.06, "{starts} starts: wrong in {wrong}");
        }
    }
}

#[test]
fn intervals_of_clustered_episodes_hold_the_truth_in_95_of_100_runs() {
    let simulation = Simulation {
        tasks: 4,
        starts: 24,
        repeats: 3,
        rates: vec![0.8, 0.6],
        agreement: 0.3,
        likeness: 0.6,
    };
    let rate = simulation.share(4, |run| Rate::over_tasks(&run[0]).interval.contains(0.8));
    assert!((0.93..0.975).contains(&rate), "{rate}");
    // The same episodes, analysed as if each had its own start.
    let naive = simulation.share(4, |run| {
        let value = Rate::over_tasks(&run[0]).value.expect("a rate");
        wilson(value, 4.0 * 24.0 * 3.0).contains(0.8)
    });
    assert!(naive < 0.88, "{naive}");
    let gains =
        simulation.share(5, |run| gain(&run[0], &run[1]).expect("pairs").interval.contains(0.2));
    assert!((0.93..0.985).contains(&gains), "{gains}");
}
