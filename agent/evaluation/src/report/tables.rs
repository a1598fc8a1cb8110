//! Tables over settings: columns on a wide page, one block per setting on a narrow one; with their numbers as CSV.

use super::escape::html;
use super::figure::csv_line;
use super::glossary::term_as;
use crate::estimate::Rate;
use crate::results::{Counts, SettingResult};

/// A column's title, and the term that explains it.
type Column = (&'static str, &'static str);

/// A cell as HTML, and its values in the CSV.
struct Cell {
    shown: String,
    values: Vec<String>,
}

const RATES: [Column; 6] = [
    ("success (%)", "success"),
    ("success at any step (%)", ""),
    ("released (%)", "released"),
    ("ever grasped (%)", ""),
    ("episodes", ""),
    ("faults", "fault"),
];

/// Success and the other rates; one row per setting.
pub fn rates(settings: &[SettingResult]) -> String {
    let mut header = vec!["setting".to_owned()];
    for name in ["success", "any_step", "released", "grasped"] {
        header.extend(["", "_low", "_high"].map(|end| format!("{name}{end}")));
    }
    header.extend(["episodes", "layouts", "faults"].map(str::to_owned));
    let cells = |result: &SettingResult| {
        let all = &result.all;
        let Rate { episodes, starts, .. } = all.success;
        let rates = [all.success, all.ever_success, all.released_success, all.grasped];
        let mut cells: Vec<Cell> = rates.into_iter().map(rate).collect();
        cells[0].shown = format!("<b>{}</b>", cells[0].shown);
        cells.push(Cell {
            shown: match episodes == starts {
                true => episodes.to_string(),
                false => format!("{episodes}<small>{starts} layouts</small>"),
            },
            values: vec![episodes.to_string(), starts.to_string()],
        });
        cells.push(alarming(all.counts.faults));
        cells
    };
    table("rates", &RATES, &header, settings, cells)
}

const COUNTS: [Column; 4] = [
    ("malformed candidates", "malformed"),
    ("steps held still", ""),
    ("policy never acted", ""),
    ("repeats", ""),
];

/// What the rates do not tell; one row per setting.
pub fn counts(settings: &[SettingResult]) -> String {
    let header =
        ["setting", "malformed", "candidates", "held_steps", "decisions", "never_acted", "repeats"];
    let cells = |result: &SettingResult| {
        let Counts { never_acted, repeats, proposed, malformed, decisions, held_steps, .. } =
            result.all.counts;
        let share = |part: u64, whole: u64| Cell {
            shown: format!("{part}<small>of {whole}</small>"),
            values: vec![part.to_string(), whole.to_string()],
        };
        vec![
            share(malformed, proposed),
            share(held_steps, decisions),
            alarming(never_acted),
            Cell { shown: repeats.to_string(), values: vec![repeats.to_string()] },
        ]
    };
    table("counts", &COUNTS, &header.map(str::to_owned), settings, cells)
}

/// Percent with its interval.
fn rate(rate: Rate) -> Cell {
    let Some(value) = rate.value else {
        return Cell { shown: "–".to_owned(), values: vec![String::new(); 3] };
    };
    let interval = rate.interval;
    let [value, low, high] = [value, interval.low, interval.high].map(|value| 100.0 * value);
    Cell {
        shown: format!("{value:.1}<small>{low:.1} to {high:.1}</small>"),
        values: [value, low, high].map(|value| format!("{value:.3}")).to_vec(),
    }
}

fn alarming(count: u64) -> Cell {
    let shown = match count {
        0 => count.to_string(),
        count => format!("<span class=\"alarming\">{count}</span>"),
    };
    Cell { shown, values: vec![count.to_string()] }
}

/// The roles are written out: as blocks, on a narrow page, a table's elements would lose them.
fn table(
    name: &str,
    columns: &[Column],
    csv_header: &[String],
    settings: &[SettingResult],
    cells: impl Fn(&SettingResult) -> Vec<Cell>,
) -> String {
    let heads = columns.iter().map(|(title, explained)| {
        format!("<th role=\"columnheader\" scope=\"col\">{}</th>", term_as(explained, title))
    });
    let heads: String = heads.collect();
    let (mut rows, mut csv) = (String::new(), csv_line(csv_header));
    for result in settings {
        let setting = result.setting.to_string();
        let cells = cells(result);
        let shown = columns.iter().zip(&cells).map(|((title, _), cell)| {
            format!("<td role=\"cell\" data-title=\"{}\">{}</td>", html(title), cell.shown)
        });
        rows.push_str(&format!(
            "<tr role=\"row\" data-strategy=\"{}\"><th role=\"rowheader\" scope=\"row\">{}</th>{}</tr>",
            html(&result.setting.strategy.to_string()),
            html(&setting),
            shown.collect::<String>()
        ));
        let values = cells.into_iter().flat_map(|cell| cell.values);
        csv.push_str(&csv_line(&std::iter::once(setting).chain(values).collect::<Vec<_>>()));
    }
    format!(
        "<figure class=\"table\" data-name=\"{name}\" data-csv=\"{}\"><table role=\"table\"><thead role=\"rowgroup\">\
         <tr role=\"row\"><th role=\"columnheader\" scope=\"col\">{}</th>{heads}</tr></thead>\
         <tbody role=\"rowgroup\">{rows}</tbody></table></figure>",
        html(&csv),
        term_as("setting", "setting")
    )
}
