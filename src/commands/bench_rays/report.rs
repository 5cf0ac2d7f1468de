//! The figures as a table, JSON, CSV, bars and lines over the number of triangles.

use super::{Args, Row};
use crate::plot::{COLORS, Chart, Line, Mark, stacked};
use anyhow::Context;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Prints the rows of one scene.
pub(super) fn print(rows: &[Row]) {
    out!("{:<34} {:>7} {:>14} {:>9} {:>7} {:>9}", "", "threads", "figure", "", "spread", "/ embree");
    for row in rows {
        let ratio = row.ratio.map_or(String::new(), |r| format!("{r:.2}"));
        let what = format!("{:<22} {}", row.accel, row.what);
        out!(
            "{what:<34} {:>7} {:>14.3} {:>9} {:>5.1} % {ratio:>9}",
            row.threads,
            row.value,
            row.unit,
            100.0 * row.spread
        );
    }
    out!("");
}

/// Writes everything measured so far; called after every case, so that an interrupted run keeps what it has.
pub(super) fn write(rows: &[Row], args: &Args) -> anyhow::Result<()> {
    let save = |path: &Option<PathBuf>, text: &dyn Fn() -> String| match path {
        Some(path) => std::fs::write(path, text()).with_context(|| format!("cannot write {}", path.display())),
        None => Ok(()),
    };
    let json = serde_json::to_string_pretty(rows)?;
    save(&args.json, &|| json.clone())?;
    save(&args.csv, &|| table(rows))?;
    save(&args.svg, &|| bars(rows))?;
    save(&args.scaling, &|| scaling(rows))
}

/// Charts over the number of triangles: rates and build time.
fn scaling(rows: &[Row]) -> String {
    let mut kinds: Vec<(&str, usize)> = rows.iter().map(|r| (r.accel.as_str(), r.threads)).collect();
    kinds.sort_unstable();
    kinds.dedup();
    let chart = |what: &str, title: &str, y_label: &str| {
        let line = |(i, &(accel, threads)): (usize, &(&str, usize))| {
            let own = rows.iter().filter(|r| r.what == what && r.accel == accel && r.threads == threads);
            let mark = |r: &Row| Mark {
                x: r.triangles as f64,
                y: r.value,
                spread: [r.value; 2],
                note: format!("{}, {} triangles: {:.3} {}", r.scene, r.triangles, r.value, r.unit),
            };
            let mut marks: Vec<Mark> = own.map(mark).collect();
            marks.sort_by(|a, b| a.x.total_cmp(&b.x));
            let plural = if threads == 1 { "" } else { "s" };
            Line { label: format!("{accel}, {threads} thread{plural}"), color: COLORS[i % COLORS.len()], marks }
        };
        Chart {
            title: title.to_owned(),
            x_label: "triangles".to_owned(),
            y_label: y_label.to_owned(),
            lines: kinds.iter().enumerate().map(line).collect(),
            levels: Vec::new(),
            floor: None,
        }
    };
    stacked(&[
        chart("grouped", "A render's shadow rays", "Mrays/s"),
        chart("camera", "Camera rays", "Mrays/s"),
        chart("any-hit", "Any hit of scattered rays", "Mrays/s"),
        chart("build", "Build", "seconds"),
    ])
}

fn table(rows: &[Row]) -> String {
    let mut text = "scene,triangles,accel,what,threads,value,unit,spread,ratio_to_embree\n".to_owned();
    for r in rows {
        let ratio = r.ratio.map_or(String::new(), |r| r.to_string());
        let quoted = |s: &str| format!("\"{}\"", s.replace('"', "\"\""));
        let (scene, accel) = (quoted(&r.scene), quoted(&r.accel));
        let _ = writeln!(
            text,
            "{scene},{},{accel},{},{},{},{},{},{ratio}",
            r.triangles, r.what, r.threads, r.value, r.unit, r.spread
        );
    }
    text
}

/// Bars of the rates, grouped by scene and kind, a colour an accelerator.
fn bars(rows: &[Row]) -> String {
    const COLORS: [&str; 6] = ["#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#b07aa1", "#9c755f"];
    let rates: Vec<_> = rows.iter().filter(|r| r.unit == "Mrays/s").collect();
    let largest = rates.iter().map(|r| r.value).fold(1e-9, f64::max);
    let mut accels: Vec<&str> = rates.iter().map(|r| r.accel.as_str()).collect();
    accels.sort_unstable();
    accels.dedup();
    let height = 20 * rates.len() + 60 + 18 * accels.len();
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"900\" height=\"{height}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"900\" height=\"{height}\" fill=\"white\"/>\n"
    );
    let escape = |s: &str| s.replace('&', "&amp;").replace('<', "&lt;");
    let color = |accel: &str| COLORS[accels.iter().position(|a| *a == accel).unwrap_or(0) % COLORS.len()];
    for (i, accel) in accels.iter().enumerate() {
        let y = 20 + 18 * i;
        let _ = writeln!(svg, "<rect x=\"10\" y=\"{}\" width=\"12\" height=\"12\" fill=\"{}\"/>", y - 10, color(accel));
        let _ = writeln!(svg, "<text x=\"28\" y=\"{y}\">{}</text>", escape(accel));
    }
    let top = 40 + 18 * accels.len();
    for (i, r) in rates.iter().enumerate() {
        let (y, width) = (top + 20 * i, 480.0 * r.value / largest);
        let label = format!(
            "{} · {} · {} thr.",
            Path::new(&r.scene).file_name().map_or_else(|| r.scene.clone().into(), |n| n.to_string_lossy()),
            r.what,
            r.threads
        );
        let _ = writeln!(svg, "<text x=\"330\" y=\"{}\" text-anchor=\"end\">{}</text>", y + 12, escape(&label));
        let _ = writeln!(
            svg,
            "<rect x=\"340\" y=\"{y}\" width=\"{width:.1}\" height=\"15\" fill=\"{}\"/><text x=\"{:.1}\" \
             y=\"{}\">{:.2} Mrays/s</text>",
            color(&r.accel),
            346.0 + width,
            y + 12,
            r.value
        );
    }
    svg += "</svg>\n";
    svg
}
