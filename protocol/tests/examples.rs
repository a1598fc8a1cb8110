//! One example of each message. The values are exact in 32 bits, so that both languages encode the
//! same numbers.

use protocol::{
    Description, Dimension, EpisodeOutcome, FaultKind, Heartbeat, Image, Observation, Open,
    Opening, PROTOCOL_VERSION, Reply, Request, Statistics, TaskDescription, Transition,
    VerifierUpdate,
};

pub fn description() -> Description {
    let dimension = |name: &str, bound: f32, discrete| Dimension {
        name: name.into(),
        low: Some(-bound),
        high: Some(bound),
        discrete,
    };
    let height = Dimension { high: None, ..dimension("height", 0.0, false) };
    let task = |task: &str, instruction: &str, steps_max, control_hz| TaskDescription {
        task: task.into(),
        variant: "default".into(),
        version: 1,
        instruction: instruction.into(),
        steps_max,
        control_hz,
        layouts: 24,
        state: vec![dimension("x", 2.0, false), height.clone()],
        action: vec![dimension("x", 0.5, false), dimension("gripper", 1.0, true)],
    };
    Description {
        protocol: PROTOCOL_VERSION,
        server: "0123456789abcdef".into(),
        simulator: "rever_env".into(),
        simulator_version: "0.0.0 mujoco 3.8.0".into(),
        tasks: vec![
            task("widowx_spoon_on_towel", "put the spoon on the towel", 60, Some(5.0)),
            task("widowx_put_eggplant_in_basket", "put eggplant into yellow basket", 120, None),
        ],
        image_side_max: 1024,
        sessions: 3,
        sessions_max: 16,
        slots_max: 16,
    }
}

pub fn heartbeat() -> Heartbeat {
    Heartbeat {
        server: "0123456789abcdef".into(),
        sessions: 3,
        steps: 70_000,
        resident_bytes: 5_000_000_000,
    }
}

pub fn open() -> Open {
    Open {
        protocol: PROTOCOL_VERSION,
        task: "widowx_spoon_on_towel".into(),
        variant: "default".into(),
        image_height: 128,
        image_width: 128,
        expert: true,
        holder: "agent".into(),
    }
}

pub fn openings() -> [(&'static str, Opening); 2] {
    [
        ("opening_opened", Opening::Opened { session: "fedcba9876543210".into() }),
        ("opening_refused", Opening::Refused { reason: "all 16 sessions are in use".into() }),
    ]
}

pub fn observation() -> Observation {
    Observation {
        image: Image { height: 2, width: 3, pixels: (0..18).map(|index| index * 14).collect() },
        state: vec![0.25, -0.125, 0.5, 0.0, -1.5, 3.0, 0.0, 1.0],
        instruction: "put the spoon on the towel".into(),
        expert_action: None,
    }
}

pub fn statistics() -> Statistics {
    Statistics { ever_grasped: true, moved_correct_object: true, ..Statistics::default() }
}

pub fn transition() -> Transition {
    let expert_action = Some(vec![0.015625, -0.0078125, 0.0, 0.0, 0.0, 0.25, -1.0]);
    Transition {
        observation: Observation { expert_action, ..observation() },
        statistics: statistics(),
        reward: 0.0,
        terminated: false,
        truncated: true,
    }
}

pub fn requests() -> [(&'static str, Request); 6] {
    let reset = |sequence, layout, seed| Request::Reset {
        sequence,
        task: "widowx_spoon_on_towel".into(),
        variant: "default".into(),
        layout,
        seed,
    };
    let action = vec![0.015625, -0.0078125, 0.0, 0.0, 0.0, 0.25, -1.0];
    [
        ("request_reset", reset(1, Some(23), 7)),
        ("request_reset_random", reset(300, None, (1 << 53) - 1)),
        ("request_step", Request::Step { sequence: 2, action }),
        ("request_save", Request::Save { sequence: 3, slot: 0 }),
        ("request_restore", Request::Restore { sequence: 70_000, slot: 15 }),
        ("request_close", Request::Close { sequence: 5_000_000_000 }),
    ]
}

/// A step that changed the second of three tiles.
fn tiles() -> Reply {
    let pixels = (0..768).map(|index| (index % 251) as u8).collect();
    let image = Image { height: 16, width: 48, pixels };
    let observation = Observation { image, ..observation() };
    Reply::Stepped {
        sequence: 8,
        transition: Transition { observation, ..transition() },
        changed_tiles: Some(vec![1]),
        simulator_us: 70_000,
    }
}

pub fn replies() -> [(&'static str, Reply); 8] {
    let reason = "slot 3 holds no state".into();
    let diverged = "expected finite speeds up to 100, got 250".into();
    let kind = FaultKind::PhysicsDiverged;
    [
        ("reply_observed", Reply::Observed { sequence: 1, observation: observation() }),
        (
            "reply_stepped",
            Reply::Stepped {
                sequence: 2,
                transition: transition(),
                changed_tiles: None,
                simulator_us: 4_250,
            },
        ),
        ("reply_saved", Reply::Saved { sequence: 3 }),
        ("reply_restored", Reply::Restored { sequence: 4, observation: observation() }),
        ("reply_closed", Reply::Closed { sequence: 5 }),
        ("reply_refused", Reply::Refused { sequence: 6, reason }),
        ("reply_faulted", Reply::Faulted { sequence: 7, kind, reason: diverged }),
        ("reply_stepped_tiles", tiles()),
    ]
}

pub fn outcome() -> EpisodeOutcome {
    EpisodeOutcome {
        run: "evaluation-7".into(),
        task: "widowx_spoon_on_towel".into(),
        variant: "default".into(),
        layout: None,
        seed: 3_000_000_000,
        episode: 12,
        strategy: "verifier".into(),
        candidates: 5,
        temperature: 0.75,
        policy: "00ff".repeat(16),
        verifier: Some("ff00".repeat(16)),
        statistics: statistics(),
        steps: 60,
        score_mean: Some(0.625),
        simulator: "rever_env 0.0.0 mujoco 3.8.0".into(),
    }
}

pub fn verifier_update() -> VerifierUpdate {
    VerifierUpdate {
        name: "default".into(),
        digest: "0a".repeat(32),
        policy: "00ff".repeat(16),
        weights: (0..=255).collect(),
    }
}
