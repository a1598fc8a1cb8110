//! Composes a task's scene in MuJoCo's XML: resolves includes and applies the task's changes.

use std::collections::BTreeMap;

use anyhow::{Context, Result, ensure};
use xmltree::{Element, XMLNode};

use crate::assets::Assets;
use crate::tasks::Task;

/// The scene as one text for MuJoCo's compiler.
pub fn scene(task: &Task) -> Result<String> {
    let mut root = included(&task.assets, &task.rule.scene)?;
    for (element, names) in &task.rule.mjcf {
        for (name, attributes) in names {
            let count = change(&mut root, None, (element, name), attributes);
            ensure!(
                count == 1,
                "{}: expected one {element} named {name}, got {count}",
                task.rule.scene
            );
        }
    }
    let mut text = Vec::new();
    root.write(&mut text)?;
    Ok(String::from_utf8(text)?)
}

/// Changes every element of this kind and name, and returns their number.
///
/// An element without a name, such as a body's inertial, is found by its parent's name.
fn change(
    node: &mut Element,
    parent: Option<&str>,
    (kind, name): (&str, &str),
    attributes: &BTreeMap<String, String>,
) -> usize {
    let own = node.attributes.get("name").cloned();
    let is_it = node.name == kind && own.as_deref().or(parent) == Some(name);
    if is_it {
        node.attributes.extend(attributes.clone());
    }
    let children = node.children.iter_mut().filter_map(XMLNode::as_mut_element);
    let below = children.map(|child| change(child, own.as_deref(), (kind, name), attributes));
    usize::from(is_it) + below.sum::<usize>()
}

fn included(assets: &Assets, name: &str) -> Result<Element> {
    let text = assets.text(name)?;
    let mut root =
        Element::parse(text.as_bytes()).with_context(|| format!("cannot read {name}"))?;
    include(&mut root, assets)?;
    Ok(root)
}

/// Replaces include elements by the content of their files.
fn include(node: &mut Element, assets: &Assets) -> Result<()> {
    let mut children = Vec::new();
    for child in std::mem::take(&mut node.children) {
        match child {
            XMLNode::Element(element) if element.name == "include" => {
                let file = element
                    .attributes
                    .get("file")
                    .context("an include element has no file attribute")?;
                children.extend(included(assets, file)?.children);
            }
            XMLNode::Element(mut element) => {
                include(&mut element, assets)?;
                children.push(XMLNode::Element(element));
            }
            other => children.push(other),
        }
    }
    node.children = children;
    Ok(())
}
