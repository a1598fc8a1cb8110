//! A figure on the page: drawn for wide and for narrow screens, with its numbers as CSV for a download.

use super::escape::html;

/// How much room a figure is drawn for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Room {
    /// Beside other things, or alone on a desk's screen.
    Wide,
    /// A telephone.
    Narrow,
}

/// A figure with a name for files, a description for those who cannot see it, and its numbers.
pub struct Figure {
    /// Of the files that are downloaded: letters and `-`.
    pub name: String,
    /// What it shows, as one sentence with its main numbers.
    pub description: String,
    /// Comma-separated values with a header line.
    pub csv: String,
}

impl Figure {
    /// The figure's markup; `draw` gives the SVG's content, its width and its height.
    pub fn html(&self, draw: impl Fn(Room) -> Drawing) -> String {
        let svg = |room: Room| {
            let Drawing { content, width, height } = draw(room);
            let class = if room == Room::Wide { "wide" } else { "narrow" };
            format!(
                "<svg class=\"{class}\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
                 role=\"img\" aria-label=\"{}\">{content}</svg>",
                html(&self.description)
            )
        };
        format!(
            "<figure data-name=\"{}\" data-csv=\"{}\">{}{}</figure>",
            html(&self.name),
            html(&self.csv),
            svg(Room::Wide),
            svg(Room::Narrow)
        )
    }
}

/// What is inside an SVG, and its size.
pub struct Drawing {
    pub content: String,
    pub width: f64,
    pub height: f64,
}

/// One line of comma-separated values.
pub fn csv_line(cells: &[String]) -> String {
    let cell = |text: &String| match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.clone(),
    };
    cells.iter().map(cell).collect::<Vec<_>>().join(",") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_with_commas_and_quotes_stay_one_cell() {
        let cells = ["a,b", "say \"x\"", "plain"].map(str::to_owned);
        assert_eq!(csv_line(&cells), "\"a,b\",\"say \"\"x\"\"\",plain\n");
    }

    #[test]
    fn a_figure_is_drawn_twice_and_its_numbers_are_escaped() {
        let figure =
            Figure { name: "gains".into(), description: "a<b".into(), csv: "x,\"y\"\n".into() };
        let text = figure.html(|room| Drawing {
            content: String::new(),
            width: if room == Room::Wide { 860.0 } else { 360.0 },
            height: 10.0,
        });
        assert_eq!(text.matches("<svg").count(), 2);
        assert!(text.contains("data-csv=\"x,&quot;y&quot;"), "{text}");
        assert!(text.contains("aria-label=\"a&lt;b\""), "{text}");
    }
}
