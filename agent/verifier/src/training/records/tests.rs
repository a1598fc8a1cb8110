//! Records of synthetic episodes, eligible and ineligible.

use decision::{ActionChunk, Reasoning};
use store::labels::{Label, LabelStore};
use store::plan::SeedRange;
use store::provenance::Provenance;
use store::record::{
    CandidateRecord, EpisodeIdentity, RECORD_VERSION, StepRecord, Versions, hidden_to_bytes,
};

use super::*;
use crate::training::STATISTICS;

fn parse(_: &[u32]) -> Result<Parsed, Malformed> {
    let actions = ActionChunk::single(vec![0.0; 7]).expect("finite");
    Ok(Parsed { reasoning: Reasoning::default(), action_tokens: vec![1; 7], actions })
}

/// The confidence of the first part is the log-probability of the first token.
fn confidence(_: &[u32], log_probabilities: &[f32]) -> Vec<f32> {
    let mut confidence = vec![0.0; 16];
    confidence[0] = log_probabilities[0];
    confidence
}

fn with_reader<T>(read: impl FnOnce(CompletionReader<'_>) -> T) -> T {
    let action_space = ActionSpace { scale: vec![1.0; 7], gripper: Some(6) };
    read(CompletionReader {
        policy: "cafe",
        action_space: &action_space,
        parse: &parse,
        confidence: &confidence,
    })
}

fn read(record: &EpisodeRecord) -> anyhow::Result<TrainingEpisode> {
    with_reader(|reader| eligible_episode(record, reader))
}

/// Three decisions with two candidates each, of which the first is executed; in the last decision
/// none is well formed. Each decision is followed by a step that executes the second action of its
/// chunk.
fn record(episode: u32) -> EpisodeRecord {
    let candidate = |value: f32, is_well_formed: bool| CandidateRecord {
        tokens: vec![1; 7],
        actions: is_well_formed.then(|| ActionChunk::single(vec![0.0; 7]).expect("finite")),
        malformed: (!is_well_formed).then(|| "expected an action, got none".to_owned()),
        unread: Vec::new(),
        score: None,
        log_probability: -1.0,
        log_probabilities: vec![-0.5; 7],
        hidden: Some(hidden_to_bytes(&[value, 0.5])),
        reading: None,
    };
    let decision = |index: usize| DecisionRecord {
        candidates: vec![candidate(index as f32, index < 4), candidate(-9.0, index < 4)],
        chosen: (index < 4).then_some(0),
        batch_ms: 1.0,
        batch_size: 1,
    };
    let step = |index: usize| StepRecord {
        state: vec![0.0; 8],
        decision: index.is_multiple_of(2).then(|| decision(index)),
        action: vec![0.0; 7],
        statistics: Statistics::default(),
        step_ms: 1.0,
        simulator_ms: 1.0,
    };
    EpisodeRecord {
        version: RECORD_VERSION,
        identity: EpisodeIdentity {
            run: "run-1".to_owned(),
            task: "widowx_stack_cube".to_owned(),
            variant: "default".to_owned(),
            layout: None,
            episode,
            seed: SeedRange::Collection.first() + u64::from(episode),
            sampling_seed: 5,
            strategy: "sample".to_owned(),
            candidates: 2,
            temperature: 1.0,
        },
        versions: Versions {
            rever: "0.0.0".to_owned(),
            commit: "unknown".to_owned(),
            protocol: 1,
            simulator: "mujoco 3.8.0".to_owned(),
            policy: "cafe".to_owned(),
            verifier: None,
        },
        instruction: "stack".to_owned(),
        steps_max: 60,
        statistics: Statistics { is_success: true, ..Statistics::default() },
        steps: (0..6).map(step).collect(),
        wall_secs: 1.0,
    }
}

fn decision(record: &mut EpisodeRecord, index: usize) -> &mut DecisionRecord {
    record.steps[index].decision.as_mut().expect("a decision")
}

/// Makes all candidates malformed.
fn never_act(record: &mut EpisodeRecord) {
    for decision in record.steps.iter_mut().filter_map(|step| step.decision.as_mut()) {
        decision.chosen = None;
        for candidate in &mut decision.candidates {
            candidate.actions = None;
            candidate.malformed = Some("expected an action, got none".to_owned());
        }
    }
}

fn write(folder: &Path, records: &[EpisodeRecord]) {
    std::fs::create_dir_all(folder.join("episodes")).expect("a folder");
    for record in records {
        record
            .write(&record_path(folder, &record.identity.id()), &Provenance::default())
            .expect("a record");
    }
}

#[test]
fn a_record_gives_the_executed_candidates_of_the_decisions_that_had_one() {
    let episode = read(&record(3)).expect("eligible");
    assert_eq!(episode.name, "run-1/widowx_stack_cube-default-0003-sample-n2-t1");
    assert_eq!(episode.hidden, [0.0, 0.5, 2.0, 0.5]);
    assert_eq!((episode.steps, episode.steps_total, episode.steps_max), (vec![0, 2], 6, 60));
    assert!(episode.is_success);
    assert_eq!(episode.start.seed, SeedRange::Collection.first() + 3);
}

#[test]
fn several_candidates_with_hidden_states_give_decisions() {
    let mut record = record(0);
    record.steps[1].statistics.is_grasped = true;
    decision(&mut record, 2).candidates[1].log_probabilities[0] = -1.5;
    let drawn = read(&record).expect("eligible").decisions.expect("two candidates");
    assert_eq!(drawn.len(), 2);
    let last = &drawn[1];
    // Hidden states 2 and -9, and the grasp of the previous step.
    assert_eq!((last.hidden_mean.as_slice(), last.statistics[1]), ([-3.5, 0.5].as_slice(), 1.0));
    let rows = last.candidates.rows();
    assert_eq!((rows[0][0], rows[1][0]), (0.5, -0.5));
    assert_eq!(drawn[0].statistics, [0.0; STATISTICS]);

    let mut forgotten = record.clone();
    decision(&mut forgotten, 2).candidates[1].hidden = None;
    assert_eq!(read(&forgotten).expect("eligible").decisions, None);
    record.identity.candidates = 1;
    assert_eq!(read(&record).expect("eligible").decisions, None);
}

#[test]
fn the_first_well_formed_candidate_is_a_sample() {
    let mut record = record(0);
    record.identity.strategy = "first-well-formed".to_owned();
    let first = decision(&mut record, 0);
    first.candidates[0].actions = None;
    first.chosen = Some(1);
    let episode = read(&record).expect("eligible");
    assert_eq!(episode.hidden, [-9.0, 0.5, 2.0, 0.5]);
}

#[test]
fn an_ineligible_episode_is_refused_with_the_reason() {
    let check = |change: fn(&mut EpisodeRecord), expected: &str| {
        let mut record = record(0);
        change(&mut record);
        let error = format!("{:#}", read(&record).expect_err(expected));
        assert_eq!(error, expected);
    };
    check(
        |record| record.identity.layout = Some(7),
        "expected a random initial layout, got layout 7",
    );
    check(
        |record| record.identity.seed = SeedRange::Evaluation.first(),
        "expected a seed in the collection range (from 1000000000), got 3000000000",
    );
    check(
        |record| record.identity.seed = SeedRange::Tuning.first() + 5,
        "expected a seed in the collection range (from 1000000000), got 2000000005",
    );
    check(|record| record.identity.temperature = 0.0, "expected a temperature above 0, got 0");
    check(
        |record| record.versions.policy = "beef".to_owned(),
        "expected hidden states of the verifier's policy, got those of policy beef",
    );
    check(|record| record.steps.clear(), "expected an outcome, got an episode without steps");
    check(
        |record| decision(record, 2).candidates[0].hidden = None,
        "step 2: expected the executed candidate's hidden state, got none",
    );
    check(
        |record| decision(record, 2).chosen = Some(1),
        "step 2: expected the first well-formed candidate to be executed, got candidate 1",
    );
}

#[test]
fn hidden_states_of_selected_candidates_are_not_used() {
    for strategy in ["verifier", "medoid", "majority", "worst", "verifier+medoid", "oracle", "???"]
    {
        let mut record = record(0);
        record.identity.strategy = strategy.to_owned();
        assert_eq!(
            read(&record).expect_err("selected").to_string(),
            format!(
                "expected an episode of strategy sample, got {strategy}; `rever collect` records them"
            )
        );
    }
}

#[test]
fn an_episode_in_which_the_policy_never_acted_has_no_outcome() {
    let mut record = record(0);
    never_act(&mut record);
    assert_eq!(
        read(&record).expect_err("no action").to_string(),
        "expected at least one executed candidate, got an episode in which the robot held still"
    );
}

#[test]
fn a_run_with_one_ineligible_record_is_refused_by_its_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let runs = [folder.path().to_path_buf()];
    write(folder.path(), &[record(0), record(1)]);
    let mut idle = record(3);
    never_act(&mut idle);
    write(folder.path(), &[idle]);
    let (episodes, excluded) = with_reader(|reader| from_runs(&runs, reader)).expect("eligible");
    assert_eq!((episodes.len(), excluded), (2, Excluded::from([("the policy never acted", 1)])));
    let mut bad = record(2);
    bad.identity.layout = Some(7);
    write(folder.path(), &[bad]);
    let error = with_reader(|reader| from_runs(&runs, reader)).expect_err("one is bad");
    let error = format!("{error:#}");
    assert!(
        error.contains("widowx_stack_cube-default-0002-sample-n2-t1.msgpack: expected a random"),
        "{error}"
    );
}

#[test]
fn a_label_store_counts_what_is_excluded_by_its_reason() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut records: Vec<EpisodeRecord> = (0..7).map(record).collect();
    records[1].identity.seed = SeedRange::Evaluation.first();
    records[2].versions.policy = "beef".to_owned();
    never_act(&mut records[4]);
    write(folder.path(), &records);
    let file = |record: &EpisodeRecord| record_path(folder.path(), &record.identity.id());
    let path = folder.path().join("labels.sqlite");
    let store = LabelStore::open(&path).expect("a store");
    for record in &records {
        let mut label = Label::new(record, &file(record));
        if record.identity.episode == 3 {
            label.record = None;
        }
        assert!(store.insert(&label).expect("a row"));
    }
    drop(store);
    // One record is damaged after its label was written, another one is changed.
    std::fs::write(file(&records[5]), b"damaged").expect("a file");
    records[6].statistics.is_success = false;
    write(folder.path(), &records[6..]);
    let from_labels = |path: &Path| with_reader(|reader| from_labels(path, reader));
    let (episodes, excluded) = from_labels(&path).expect("a whole store");
    assert_eq!(episodes.len(), 1);
    let expected = [
        ("another policy", 1),
        ("record cannot be read", 1),
        ("record differs from its label", 1),
        ("record on another machine", 1),
        ("seed outside the collection range", 1),
        ("the policy never acted", 1),
    ];
    assert_eq!(excluded, BTreeMap::from(expected));

    // The run is removed and started again with the same options.
    records[0].identity.run = "again".to_owned();
    write(folder.path(), &records[..1]);
    assert_eq!(from_labels(&path).expect("a whole store").1["record of another run"], 1);
    std::fs::remove_file(file(&records[0])).expect("it is there");
    assert_eq!(from_labels(&path).expect("a whole store").1["record is missing"], 1);
    let missing = from_labels(&folder.path().join("none.sqlite")).expect_err("no store");
    assert!(
        missing.to_string().ends_with(
            "none.sqlite does not exist; run `rever collect` first, or name runs or --labels"
        ),
        "{missing}"
    );
}
