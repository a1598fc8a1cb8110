//! Success against the number of candidates: one line per strategy and temperature, named at its end.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::axis::Axis;
use super::escape;
use super::figure::{Drawing, Figure, Room, csv_line};

/// One line of the figure; rates are fractions.
pub struct Series {
    pub label: String,
    /// The strategy, so that the style sheet can give it its colour.
    pub strategy: String,
    pub points: Vec<Point>,
}

/// Success with its 95 % interval at one number of candidates.
pub struct Point {
    pub candidates: usize,
    pub rate: f64,
    pub low: f64,
    pub high: f64,
}

const HEIGHT: f64 = 340.0;
/// Between lines at the same number of candidates, so that none hides another.
const DODGE: f64 = 5.0;
/// Between names at the ends of the lines.
const LINE: f64 = 17.0;

/// The figure, or nothing when no strategy ran with at least two numbers of candidates.
pub fn figure(series: &[Series]) -> String {
    let series: Vec<&Series> = series.iter().filter(|one| one.points.len() > 1).collect();
    if series.is_empty() {
        return String::new();
    }
    let header = ["setting", "candidates", "success", "low", "high"].map(str::to_owned);
    let mut csv = csv_line(&header);
    for one in &series {
        for point in &one.points {
            let rates = [point.rate, point.low, point.high];
            let [rate, low, high] = rates.map(|value| format!("{:.3}", 100.0 * value));
            let cells = [one.label.clone(), point.candidates.to_string(), rate, low, high];
            csv.push_str(&csv_line(&cells));
        }
    }
    let names: Vec<&str> = series.iter().map(|one| one.label.as_str()).collect();
    let figure = Figure {
        name: "success-against-candidates".to_owned(),
        description: format!(
            "Success in percent against the number of candidates per step, with 95 % intervals: {}",
            names.join(", ")
        ),
        csv,
    };
    figure.html(|room| draw(&series, room))
}

fn draw(series: &[&Series], room: Room) -> Drawing {
    let points = || series.iter().flat_map(|one| &one.points);
    let most = points().map(|point| point.candidates).max().unwrap_or(1);
    let top = points().map(|point| point.high).fold(0.0, f64::max);
    let bottom = points().map(|point| point.low).fold(1.0, f64::min);
    // A telephone has no room beside the plot: names go below it.
    let (width, names, below) = match room {
        Room::Wide => (760.0, 210.0, 0.0),
        Room::Narrow => (350.0, 18.0, LINE * series.len() as f64 + 8.0),
    };
    let across = Axis { low: 1.0, high: most as f64, from: 58.0, to: width - names };
    let up = Axis {
        low: (bottom * 10.0).floor() * 10.0,
        high: (top * 10.0).ceil() * 10.0,
        from: HEIGHT - 50.0,
        to: 30.0,
    };
    let mut svg = String::new();
    frame(&mut svg, &up, &across, points().map(|point| point.candidates).collect());
    let places = name_places(series, &up, room);
    for (index, one) in series.iter().enumerate() {
        let shift = DODGE * (index as f64 - (series.len() as f64 - 1.0) / 2.0);
        let end = match room {
            Room::Wide => (across.to + 26.0, places[index]),
            Room::Narrow => (58.0, places[index]),
        };
        // The same strategy at another temperature has its colour and another line.
        let is_again = series[..index].iter().any(|other| other.strategy == one.strategy);
        line(&mut svg, (one, is_again), (&across, &up), shift, end);
    }
    Drawing { content: svg, width, height: HEIGHT + below }
}

/// Where the names stand: at the height of the lines' ends where there is room for all of them, else moved apart.
fn name_places(series: &[&Series], up: &Axis, room: Room) -> Vec<f64> {
    if room == Room::Narrow {
        return (0..series.len()).map(|index| HEIGHT + 8.0 + LINE * index as f64).collect();
    }
    let end = |one: &&Series| one.points.last().map_or(0.0, |point| up.at(100.0 * point.rate));
    let mut order: Vec<usize> = (0..series.len()).collect();
    order.sort_by(|a, b| end(&series[*a]).total_cmp(&end(&series[*b])));
    let mut places = vec![0.0; series.len()];
    let mut last = f64::NEG_INFINITY;
    for index in order {
        last = end(&series[index]).max(last + LINE);
        places[index] = last;
    }
    let beyond = (last - (HEIGHT - 50.0)).max(0.0);
    places.iter().map(|place| place - beyond).collect()
}

fn frame(svg: &mut String, up: &Axis, across: &Axis, candidates: BTreeSet<usize>) {
    for tick in up.ticks(5) {
        let place = up.at(tick);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{place:.1}\" y2=\"{place:.1}\"/>\
             <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{tick:.0}</text>",
            across.from - 12.0,
            across.to + 14.0,
            across.from - 18.0,
            place + 4.0
        );
    }
    for count in candidates {
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{count}</text>",
            across.at(count as f64),
            HEIGHT - 28.0
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"2\" y=\"14\">success at the last step (%)</text>\
         <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">candidates per step (N)</text>",
        f64::midpoint(across.from, across.to),
        HEIGHT - 8.0
    );
}

fn line(
    svg: &mut String,
    (one, is_again): (&Series, bool),
    (across, up): (&Axis, &Axis),
    shift: f64,
    (x, y): (f64, f64),
) {
    let place = |point: &Point| across.at(point.candidates as f64) + shift;
    let points: Vec<String> = one
        .points
        .iter()
        .map(|point| format!("{:.1},{:.1}", place(point), up.at(100.0 * point.rate)))
        .collect();
    let _ = write!(
        svg,
        "<g class=\"series\" data-strategy=\"{}\"><polyline class=\"{}\" points=\"{}\"/>",
        escape::html(&one.strategy),
        if is_again { "again" } else { "first" },
        points.join(" ")
    );
    for point in &one.points {
        let (low, high) = (up.at(100.0 * point.low), up.at(100.0 * point.high));
        let _ = write!(
            svg,
            "<path class=\"whisker\" d=\"M{0:.1} {low:.1}V{high:.1}\"/><circle class=\"value\" cx=\"{0:.1}\" cy=\"{1:.1}\" \
             r=\"4\"><title>{2}, {3} candidates: {4:.1} % [{5:.1}, {6:.1}]</title></circle>",
            place(point),
            up.at(100.0 * point.rate),
            escape::html(&one.label),
            point.candidates,
            100.0 * point.rate,
            100.0 * point.low,
            100.0 * point.high
        );
    }
    let _ = write!(
        svg,
        "<line class=\"key\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>\
         <text class=\"name\" x=\"{x:.1}\" y=\"{:.1}\">{}</text></g>",
        x - 20.0,
        x - 6.0,
        y + 4.5,
        escape::html(&one.label)
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(label: &str, rates: &[f64]) -> Series {
        let point = |(index, rate): (usize, &f64)| Point {
            candidates: [1, 5, 9][index],
            rate: *rate,
            low: rate - 0.1,
            high: rate + 0.1,
        };
        let points = rates.iter().enumerate().map(point).collect();
        Series { label: label.into(), strategy: label.into(), points }
    }

    #[test]
    fn a_line_needs_two_numbers_of_candidates() {
        assert_eq!(figure(&[series("verifier", &[0.3])]), "");
        let text = figure(&[series("verifier", &[0.3, 0.42])]);
        assert_eq!(text.matches("<circle").count(), 2 * 2, "in both widths");
        assert!(text.contains("verifier, 5 candidates: 42.0 % [32.0, 52.0]"), "{text}");
        assert!(text.contains("verifier,5,42.000,32.000,52.000"), "{text}");
    }

    #[test]
    fn lines_with_the_same_points_and_their_names_do_not_hide_each_other() {
        let lines: Vec<Series> = ["a", "b", "c", "d", "e", "f", "g", "h"]
            .map(|name| series(name, &[0.3, 0.42]))
            .into_iter()
            .collect();
        let lines: Vec<&Series> = lines.iter().collect();
        let drawing = draw(&lines, Room::Wide);
        let up = Axis { low: 20.0, high: 60.0, from: HEIGHT - 50.0, to: 30.0 };
        let mut places = name_places(&lines, &up, Room::Wide);
        places.sort_by(f64::total_cmp);
        assert!(places.windows(2).all(|two| two[1] - two[0] >= LINE - 1e-9), "{places:?}");
        let different: BTreeSet<&str> = drawing.content.split("<polyline").skip(1).collect();
        assert_eq!(different.len(), 8, "no line is left out or drawn over another");
    }
}
