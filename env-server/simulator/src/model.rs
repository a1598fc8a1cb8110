//! A compiled scene and the indices of its elements named in tasks.toml.

use std::sync::Arc;

use mujoco_rs::prelude::*;

use crate::fault::Fault;
use crate::mjcf;
use crate::tasks::Task;

/// In the world frame, in metres or newtons.
pub type Vector = [f64; 3];

/// Indices of bodies, joints, actuators, a site and a camera.
#[derive(Debug, Clone)]
pub struct Names {
    pub source: usize,
    pub target: usize,
    pub base: usize,
    pub fingers: [usize; 2],
    pub tcp: usize,
    pub camera: usize,
    pub arm: [usize; 6],
    pub arm_actuators: [usize; 6],
    pub finger_joints: [usize; 2],
    pub finger_actuators: [usize; 2],
    /// Free joints of source and target; `None` for a target that does not move.
    pub source_joint: usize,
    pub target_joint: Option<usize>,
    pub distractors: Vec<usize>,
    pub distractor_joints: Vec<usize>,
}

/// Compiles a task's scene.
pub fn compile(task: &Task) -> Result<(Arc<MjModel>, Names), Fault> {
    let cannot =
        |error: String| Fault::Internal(format!("cannot compile task {}: {error}", task.id));
    let text = mjcf::scene(task).map_err(|error| cannot(format!("{error:#}")))?;
    let model = MjModel::from_xml_string(&text).map_err(|error| cannot(error.to_string()))?;
    let timestep = model.opt().timestep;
    if timestep != task.settings.timestep {
        return Err(Fault::Internal(format!(
            "{}: expected the time step of tasks.toml ({}), got {timestep}",
            task.rule.scene, task.settings.timestep
        )));
    }
    let names = names(&model, task)?;
    Ok((Arc::new(model), names))
}

fn names(model: &MjModel, task: &Task) -> Result<Names, Fault> {
    let settings = &task.settings;
    let find = |kind: MjtObj, name: &str| {
        model.name_to_id(kind, name).ok_or_else(|| {
            Fault::Internal(format!(
                "{}: expected an element {name:?} ({kind:?}), got none",
                task.rule.scene
            ))
        })
    };
    let body = |name: &str| find(MjtObj::mjOBJ_BODY, name);
    let joint = |name: &str| find(MjtObj::mjOBJ_JOINT, name);
    let actuator = |name: &str| find(MjtObj::mjOBJ_ACTUATOR, name);
    let distractors = task.rule.distractors.iter().map(|distractor| distractor.body.as_str());
    Ok(Names {
        source: body(&task.rule.source)?,
        target: body(&task.rule.target)?,
        base: body(&settings.robot_body)?,
        fingers: all(&settings.finger_bodies, body)?,
        tcp: find(MjtObj::mjOBJ_SITE, &settings.tcp)?,
        camera: find(MjtObj::mjOBJ_CAMERA, &settings.camera)?,
        arm: all(&settings.arm_joints, joint)?,
        arm_actuators: all(&settings.arm_joints, actuator)?,
        finger_joints: all(&settings.finger_joints, joint)?,
        finger_actuators: all(&settings.finger_joints, actuator)?,
        source_joint: joint(&task.rule.source)?,
        target_joint: task.rule.target_height.map(|_| joint(&task.rule.target)).transpose()?,
        distractors: distractors.clone().map(body).collect::<Result<_, _>>()?,
        distractor_joints: distractors.map(joint).collect::<Result<_, _>>()?,
    })
}

fn all<const N: usize>(
    names: &[String; N],
    find: impl Fn(&str) -> Result<usize, Fault>,
) -> Result<[usize; N], Fault> {
    let mut found = [0; N];
    for (place, name) in found.iter_mut().zip(names) {
        *place = find(name)?;
    }
    Ok(found)
}
