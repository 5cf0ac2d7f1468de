//! Log-log charts as SVG: one line a method, labelled where it ends, readable from the back of a room.

use crate::markup::escape;
use std::fmt::Write;

/// Colours that stay apart for colour-blind eyes (after Okabe & Ito), in the order of the lines.
pub(crate) const COLORS: [&str; 8] =
    ["#d55e00", "#0072b2", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#5b5b66", "#7a3fb0"];

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 500.0;
/// What is left free: left, top, right (for the labels, at least), bottom.
const MARGIN: [f64; 4] = [76.0, 52.0, 196.0, 58.0];

/// From the axes to the lines' names, and what a letter of these takes in a wide font.
const LABEL: f64 = 14.0;
const LETTER: f64 = 10.0;

/// A line's point with what to say about it and how far the single runs lie apart.
#[derive(Debug, Clone)]
pub(crate) struct Mark {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) spread: [f64; 2],
    pub(crate) note: String,
}

#[derive(Debug, Clone)]
pub(crate) struct Line {
    pub(crate) label: String,
    pub(crate) color: &'static str,
    pub(crate) marks: Vec<Mark>,
}

/// A log-log chart. Values that are not above zero are left out.
#[derive(Debug, Clone)]
pub(crate) struct Chart {
    pub(crate) title: String,
    pub(crate) x_label: String,
    pub(crate) y_label: String,
    pub(crate) lines: Vec<Line>,
    /// Levels of y that are drawn across.
    pub(crate) levels: Vec<f64>,
    /// Below this y, nothing can be told.
    pub(crate) floor: Option<f64>,
}

/// Charts below each other, as one SVG.
pub(crate) fn stacked(charts: &[Chart]) -> String {
    let height = HEIGHT * charts.len() as f64;
    let mut svg = format!("<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\">\n");
    for (i, chart) in charts.iter().enumerate() {
        let placed = format!("<svg y=\"{}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" ", i as f64 * HEIGHT);
        svg += &chart.svg().replacen("<svg ", &placed, 1);
    }
    svg + "</svg>\n"
}

/// One axis: the exponents shown, and the pixels they lie at.
#[derive(Debug, Clone, Copy)]
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn new(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (low, high) = values
            .filter(|v| *v > 0.0 && v.is_finite())
            .fold((f64::INFINITY, 0.0f64), |(a, b), v| (a.min(v), b.max(v)));
        let (low, high) = if low <= high { (low.log10(), high.log10()) } else { (-1.0, 1.0) };
        let room = 0.06 * (high - low).max(1.0);
        Self { low: low - room, high: high + room, from, to }
    }
    fn at(&self, value: f64) -> f64 {
        self.from + (value.log10() - self.low) / (self.high - self.low) * (self.to - self.from)
    }
    /// Values of the grid's lines, and whether each is labelled.
    fn ticks(&self) -> Vec<(f64, bool)> {
        let wide = self.high - self.low > 1.7;
        let mut ticks = Vec::new();
        for exponent in self.low.floor() as i32..=self.high.ceil() as i32 {
            for digit in 1..10 {
                let value = f64::from(digit) * 10f64.powi(exponent);
                if (self.low..=self.high).contains(&value.log10()) {
                    ticks.push((value, digit == 1 || (!wide && matches!(digit, 2 | 5))));
                }
            }
        }
        ticks
    }
}

/// A number as an axis shows it: `0.001`, `20`, `5 M`.
fn tick(value: f64) -> String {
    let (value, unit) = match value {
        v if v >= 0.99e9 => (v * 1e-9, " G"),
        v if v >= 0.99e6 => (v * 1e-6, " M"),
        v if v >= 0.99e4 => (v * 1e-3, " k"),
        v => (v, ""),
    };
    if value < 0.99e-4 {
        return format!("{value:.0e}");
    }
    let digits = (-value.log10() - 1e-9).ceil().max(0.0) as usize;
    format!("{value:.digits$}{unit}")
}

impl Chart {
    /// The chart as a self-contained SVG element.
    pub(crate) fn svg(&self) -> String {
        let [left, top, right, bottom] = MARGIN;
        let longest = self.lines.iter().map(|line| line.label.chars().count()).max().unwrap_or(0);
        let right = right.max((LETTER * longest as f64 + LABEL + 4.0).min(WIDTH / 2.0));
        let marks = || self.lines.iter().flat_map(|l| &l.marks);
        let x = Axis::new(marks().map(|m| m.x), left, WIDTH - right);
        let y = Axis::new(marks().flat_map(|m| [m.y, m.spread[0], m.spread[1]]), HEIGHT - bottom, top);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
             font-family=\"Inter, 'Helvetica Neue', Arial, sans-serif\" font-size=\"15\" fill=\"#26262b\">\n\
             <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/>\n"
        );
        let _ = writeln!(
            svg,
            "<text x=\"{left}\" y=\"28\" font-size=\"19\" font-weight=\"600\">{}</text>",
            escape(&self.title)
        );
        self.grid(&mut svg, x, y);
        for line in &self.lines {
            draw(&mut svg, line, x, y);
        }
        self.labels(&mut svg, x, y);
        svg + "</svg>\n"
    }

    fn grid(&self, svg: &mut String, x: Axis, y: Axis) {
        let color = |labelled: bool| if labelled { "#d9d9df" } else { "#f0f0f3" };
        for (value, labelled) in x.ticks() {
            let at = x.at(value);
            let _ = writeln!(svg, "<path d=\"M{at:.1} {:.1}V{:.1}\" stroke=\"{}\"/>", y.from, y.to, color(labelled));
            if labelled {
                let _ = writeln!(
                    svg,
                    "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                    y.from + 21.0,
                    tick(value)
                );
            }
        }
        for (value, labelled) in y.ticks() {
            let at = y.at(value);
            let _ = writeln!(svg, "<path d=\"M{:.1} {at:.1}H{:.1}\" stroke=\"{}\"/>", x.from, x.to, color(labelled));
            if labelled {
                let _ = writeln!(
                    svg,
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                    x.from - 9.0,
                    at + 5.0,
                    tick(value)
                );
            }
        }
        for &level in self.levels.iter().filter(|level| (y.low..=y.high).contains(&level.log10())) {
            let at = y.at(level);
            let _ = writeln!(
                svg,
                "<path d=\"M{:.1} {at:.1}H{:.1}\" stroke=\"#777\" stroke-dasharray=\"5 5\"/>",
                x.from, x.to
            );
        }
        if let Some(floor) = self.floor.filter(|floor| *floor > 0.0 && floor.log10() > y.low) {
            let at = y.at(floor).max(y.to);
            let _ = writeln!(
                svg,
                "<rect x=\"{:.1}\" y=\"{at:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"#000\" opacity=\".06\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" font-size=\"12\" fill=\"#777\">noise of the reference (taken off)</text>",
                x.from,
                x.to - x.from,
                y.from - at,
                x.from + 8.0,
                (at + 15.0).min(y.from - 4.0)
            );
        }
        let (middle, height) = (0.5 * (x.from + x.to), 0.5 * (y.from + y.to));
        let _ = writeln!(
            svg,
            "<text x=\"{middle:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text transform=\"translate(20 {height:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            HEIGHT - 12.0,
            escape(&self.x_label),
            escape(&self.y_label)
        );
    }

    /// Each line's name at its end, pushed apart where they would touch.
    fn labels(&self, svg: &mut String, x: Axis, y: Axis) {
        const APART: f64 = 19.0;
        let end = |line: &Line| line.marks.iter().rfind(|m| m.x > 0.0 && m.y > 0.0).map(|m| [x.at(m.x), y.at(m.y)]);
        let mut ends: Vec<_> = self.lines.iter().filter_map(|line| Some((line, end(line)?))).collect();
        ends.sort_by(|a, b| a.1[1].total_cmp(&b.1[1]));
        let mut at: Vec<f64> = ends.iter().map(|(_, end)| end[1]).collect();
        for i in 1..at.len() {
            at[i] = at[i].max(at[i - 1] + APART);
        }
        let mut most = y.from;
        for place in at.iter_mut().rev() {
            *place = place.min(most);
            most = *place - APART;
        }
        for ((line, [ex, ey]), ty) in ends.iter().zip(at) {
            let tx = x.to + LABEL;
            let _ = writeln!(
                svg,
                "<path d=\"M{:.1} {ey:.1}L{:.1} {ty:.1}\" stroke=\"{}\" stroke-width=\"1\" opacity=\".45\" fill=\"none\"/>\
                 <text x=\"{tx:.1}\" y=\"{:.1}\" fill=\"{}\" font-weight=\"600\">{}</text>",
                ex + 6.0,
                tx - 3.0,
                line.color,
                ty + 5.0,
                line.color,
                escape(&line.label)
            );
        }
    }
}

fn draw(svg: &mut String, line: &Line, x: Axis, y: Axis) {
    let seen: Vec<&Mark> = line.marks.iter().filter(|m| m.x > 0.0 && m.y > 0.0).collect();
    let path: Vec<String> = seen.iter().map(|m| format!("{:.1} {:.1}", x.at(m.x), y.at(m.y))).collect();
    if path.len() > 1 {
        let _ = writeln!(
            svg,
            "<path d=\"M{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"3\" stroke-linejoin=\"round\"/>",
            path.join("L"),
            line.color
        );
    }
    for m in seen {
        let (cx, [low, high]) = (x.at(m.x), m.spread);
        if low > 0.0 && high > low {
            let _ = writeln!(
                svg,
                "<path d=\"M{cx:.1} {:.1}V{:.1}\" stroke=\"{}\" opacity=\".6\"/>",
                y.at(low),
                y.at(high),
                line.color
            );
        }
        let _ = writeln!(
            svg,
            "<circle cx=\"{cx:.1}\" cy=\"{:.1}\" r=\"5\" fill=\"#fff\" stroke=\"{}\" stroke-width=\"2.5\"><title>{}</title></circle>",
            y.at(m.y),
            line.color,
            escape(&m.note)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_labelled_in_plain_numbers() {
        let shown = [0.001, 0.02, 1.0, 50.0, 2e4, 1e7, 2e-5].map(tick);
        assert_eq!(shown, ["0.001", "0.02", "1", "50", "20 k", "10 M", "2e-5"]);
    }

    #[test]
    fn names_have_room_at_the_right() {
        let marks = vec![Mark { x: 1.0, y: 0.1, spread: [0.1, 0.1], note: String::new() }];
        let label = "tessellated:cache=off,groups=512".to_owned();
        let lines = vec![Line { label: label.clone(), color: COLORS[0], marks }];
        let text = String::new();
        let svg =
            Chart { title: text.clone(), x_label: text.clone(), y_label: text, lines, levels: vec![], floor: None }
                .svg();
        let before = svg.split(&label).next().unwrap().rsplit("<text x=\"").next().unwrap();
        let at: f64 = before.split('"').next().unwrap().parse().unwrap();
        assert!(at + 9.5 * label.len() as f64 <= WIDTH, "begins at {at}");
    }

    #[test]
    fn an_empty_chart_and_one_with_a_single_point_are_whole() {
        let mark = Mark { x: 1.0, y: 0.1, spread: [0.1, 0.1], note: "a < b".into() };
        let line = |marks| Line { label: "a & b".into(), color: COLORS[0], marks };
        for lines in [vec![], vec![line(vec![])], vec![line(vec![mark])]] {
            let chart = Chart {
                title: "t".into(),
                x_label: "x".into(),
                y_label: "y".into(),
                lines,
                levels: vec![0.1],
                floor: None,
            };
            let svg = chart.svg();
            assert!(svg.ends_with("</svg>\n") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
