//! The page itself: the template with its places filled, and the files that it loads.

use anyhow::ensure;

const TEMPLATE: &str = include_str!("page/page.html");

/// Files that every report has, by name.
pub const FILES: [(&str, &str); 10] = [
    ("style.css", include_str!("page/style.css")),
    ("viewer.css", include_str!("page/viewer.css")),
    ("elements.js", include_str!("page/elements.js")),
    ("stage.js", include_str!("page/stage.js")),
    ("strip.js", include_str!("page/strip.js")),
    ("candidates.js", include_str!("page/candidates.js")),
    ("player.js", include_str!("page/player.js")),
    ("list.js", include_str!("page/list.js")),
    ("figures.js", include_str!("page/figures.js")),
    ("viewer.js", include_str!("page/viewer.js")),
];

/// What changes from run to run; all of it is HTML already.
pub struct Page {
    pub title: String,
    pub header: String,
    pub links: String,
    pub sections: String,
    pub footer: String,
}

impl Page {
    /// The text of `index.html`.
    pub fn html(&self) -> anyhow::Result<String> {
        fill(
            TEMPLATE,
            &[
                ("title", &self.title),
                ("header", &self.header),
                ("links", &self.links),
                ("sections", &self.sections),
                ("footer", &self.footer),
            ],
        )
    }
}

/// Fills `{{name}}` in one pass, so that a value that looks like a place is left as it is.
fn fill(template: &str, values: &[(&str, &str)]) -> anyhow::Result<String> {
    let mut text = String::with_capacity(template.len());
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        let (name, following) = after.split_once("}}").unwrap_or((after, ""));
        let value = values.iter().find(|(known, _)| *known == name);
        ensure!(value.is_some(), "the page has a place {name:?} that nothing fills");
        text.push_str(before);
        text.push_str(value.map_or("", |(_, value)| value));
        rest = following;
    }
    text.push_str(rest);
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_not_filled_again() {
        let filled = fill("a {{x}} b {{y}}.", &[("x", "{{y}}"), ("y", "2")]).expect("filled");
        assert_eq!(filled, "a {{y}} b 2.");
        assert!(fill("{{z}}", &[("x", "1")]).is_err());
    }
}
