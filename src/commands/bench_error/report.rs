//! The study so far, as a table, CSV, JSON, a chart and a page.

use super::measure::Bench;
use super::reference::Reference;
use super::study::{Against, Ratio, Reached, Row, front, seconds_to};
use super::{Args, Pictures, page};
use crate::plot::{COLORS, Chart, Line, Mark};
use anyhow::Result;
use domelight::output::write_atomically;
use serde_json::json;
use std::io::Write;
use std::path::Path;

#[derive(Debug)]
pub(super) struct Report<'a> {
    pub(super) args: &'a Args,
    pub(super) reference: &'a Reference,
    pub(super) rows: Vec<Row>,
    /// Each sampler's first picture at the largest budget.
    pub(super) pictures: Pictures,
    pub(super) samplers: Vec<String>,
    /// What and where was measured, for the page and the JSON.
    pub(super) facts: Vec<(&'static str, String)>,
}

/// What can be asked of a row for an x axis.
type Of = fn(&Row) -> f64;

impl<'a> Report<'a> {
    pub(super) fn new(args: &'a Args, bench: &Bench, reference: &'a Reference, threads: usize) -> Self {
        let name = |path: &Path| path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let stats = bench.dome.stats();
        let facts = vec![
            ("Scene", format!("{}, {} triangles", name(&args.input.scene_file), bench.scene.triangle_count())),
            (
                "Dome",
                format!(
                    "{}, {} × {}, brightest {:.0} times the mean",
                    name(&args.input.dome),
                    stats.width,
                    stats.height,
                    stats.contrast
                ),
            ),
            ("Image", format!("{} × {}, box filter, misses {}", args.size[0], args.size[1], args.background)),
            ("Structure", args.accel.clone()),
            ("Reference", reference.about.clone()),
            ("Machine", format!("{}, {threads} threads", processor())),
            ("Program", format!("domelight {}", env!("CARGO_PKG_VERSION"))),
        ];
        Self { args, reference, rows: Vec::new(), pictures: Vec::new(), samplers: args.samplers(), facts }
    }

    /// Takes a case's newest medians.
    pub(super) fn put(&mut self, row: Row) {
        let same = |r: &&mut Row| (&r.sampler, r.spp, r.rays) == (&row.sampler, row.spp, row.rays);
        match self.rows.iter_mut().find(same) {
            Some(old) => *old = row,
            None => self.rows.push(row),
        }
    }

    /// How long each sampler takes to each target.
    pub(super) fn reached(&self) -> Vec<Reached> {
        let of = |target: &f64| self.samplers.iter().map(|s| seconds_to(&self.rows, s, *target)).collect::<Vec<_>>();
        self.args.to_error.iter().flat_map(of).collect()
    }

    pub(super) fn print_since(&self, last: usize) {
        if self.rows.len() == last {
            out!(
                "{:<26} {:>8} {:>10} {:>8} {:>9} {:>9} {:>8} {:>11} {:>7}  {:<17}",
                "",
                "budget",
                "relMSE",
                "±",
                "RMSE",
                "cpu s",
                "prep. s",
                "relMSE·s",
                "ns/ray",
                "ratio"
            );
        }
        for r in &self.rows[self.rows.len() - last..] {
            out!(
                "{:<26} {:>8} {:>10.2e} {:>6.1} % {:>9.2e} {:>9.3} {:>8.3} {:>11.2e} {:>7.1}  {:.4} ± {:.4}{}",
                r.sampler,
                format!("{}x{}", r.spp, r.rays),
                r.relmse,
                50.0 * (r.relmse_range[1] - r.relmse_range[0]) / r.relmse,
                r.rmse,
                r.cpu_s,
                r.prepare_s,
                r.relmse_s,
                r.ns_a_ray,
                r.ratio,
                r.ratio_error,
                if r.drowned { "  below the reference's noise: more --reference-rays" } else { "" }
            );
        }
    }

    /// All others against the first, run by run.
    pub(super) fn print_against(&self) {
        let others = || self.rows.iter().filter(|r| r.sampler != self.samplers[0]);
        if others().all(|r| r.against_first.is_none()) {
            return;
        }
        let title = format!("against {}, 95 %", self.samplers[0]);
        out!("\n{title:<36} {:>22} {:>24}", "relMSE ×", "relMSE·s ×");
        for r in others() {
            let Some(Against { relmse, relmse_s }) = &r.against_first else { continue };
            let ratio = |Ratio { mean, interval: [low, high] }: &Ratio| format!("{mean:.3} [{low:.3}, {high:.3}]");
            let budget = format!("{}x{}", r.spp, r.rays);
            out!("{:<26} {budget:>9} {:>22} {:>24}", r.sampler, ratio(relmse), ratio(relmse_s));
        }
    }

    pub(super) fn print_reached(&self) {
        out!("\n{:<26} {:>10} {:>12}", "", "to relMSE", "cpu s");
        let reached = self.reached();
        for r in &reached {
            let seconds = r.seconds.map_or_else(|| "never".to_owned(), |s| format!("{s:.3}"));
            out!(
                "{:<26} {:>10} {seconds:>12}{}",
                r.sampler,
                r.target,
                if r.extrapolated { " (extrapolated)" } else { "" }
            );
        }
        let unsteady = |r: &&Row| r.cpu_range[1] > 1.25 * r.cpu_range[0];
        let count = self.rows.iter().filter(unsteady).count();
        if count > 0 {
            out!(
                "\nwarning: CPU time varies by more than 25 % in {count} of {} cases: close other programs",
                self.rows.len()
            );
        }
    }

    /// CSV and JSON.
    pub(super) fn write_figures(&self) -> Result<()> {
        if let Some(path) = &self.args.csv {
            write(path, &self.csv())?;
        }
        if let Some(path) = &self.args.json {
            let facts: serde_json::Map<_, _> = self.facts.iter().map(|(k, v)| ((*k).to_owned(), json!(v))).collect();
            let all = json!({ "facts": facts, "reference_noise": self.reference.noise, "rows": self.rows, "reached": self.reached() });
            write(path, &(serde_json::to_string_pretty(&all)? + "\n"))?;
        }
        Ok(())
    }

    /// SVG and page.
    pub(super) fn write_plots(&self) -> Result<()> {
        if let Some(path) = &self.args.svg {
            write(path, &self.by_time().svg())?;
        }
        if let Some(path) = &self.args.html {
            write(path, &page::html(self)?)?;
        }
        Ok(())
    }

    fn csv(&self) -> String {
        let mut text = "sampler,spp,rays,repeats,relmse,relmse_least,relmse_most,rmse,cpu_s,prepare_s,wall_s,relmse_s,\
                        camera_rays,shadow_rays,ns_a_ray,ratio,ratio_error\n"
            .to_owned();
        for r in &self.rows {
            let [least, most] = r.relmse_range;
            text += &format!(
                "\"{}\",{},{},{},{},{least},{most},{},{},{},{},{},{},{},{},{},{}\n",
                r.sampler,
                r.spp,
                r.rays,
                r.repeats,
                r.relmse,
                r.rmse,
                r.cpu_s,
                r.prepare_s,
                r.wall_s,
                r.relmse_s,
                r.camera_rays,
                r.shadow_rays,
                r.ns_a_ray,
                r.ratio,
                r.ratio_error
            );
        }
        text
    }

    pub(super) fn by_time(&self) -> Chart {
        self.chart("Error against time", "CPU seconds, preparation included", |r| r.cpu_s)
    }

    pub(super) fn by_rays(&self) -> Chart {
        self.chart("Error against rays", "shadow rays traced", |r| r.shadow_rays as f64)
    }

    fn chart(&self, title: &str, x_label: &str, x: Of) -> Chart {
        let mark = |r: &Row| Mark {
            x: x(r),
            y: r.relmse,
            spread: r.relmse_range,
            note: format!(
                "{}, {} × {} rays: relMSE {:.2e} in {:.3} CPU s, {} rays",
                r.sampler, r.spp, r.rays, r.relmse, r.cpu_s, r.shadow_rays
            ),
        };
        let line = |(s, sampler): (usize, &String)| {
            let mut rows: Vec<&Row> = self.rows.iter().filter(|r| r.sampler == *sampler).collect();
            rows.sort_by(|a, b| x(a).total_cmp(&x(b)).then(b.relmse.total_cmp(&a.relmse)));
            Line { label: sampler.clone(), color: self.color(s), marks: rows.into_iter().map(mark).collect() }
        };
        Chart {
            title: title.to_owned(),
            x_label: x_label.to_owned(),
            y_label: "relMSE".to_owned(),
            lines: self.samplers.iter().enumerate().map(line).collect(),
            levels: self.args.to_error.clone(),
            floor: Some(self.reference.noise.relmse),
        }
    }

    pub(super) fn color(&self, sampler: usize) -> &'static str {
        COLORS[sampler % COLORS.len()]
    }

    /// The cheapest front's last row of a sampler: what it comes to.
    pub(super) fn best(&self, sampler: &str) -> Option<&Row> {
        front(&self.rows, sampler).last().copied()
    }
}

fn write(path: &Path, text: &str) -> Result<()> {
    Ok(write_atomically(path, |file| file.write_all(text.as_bytes()))?)
}

/// The processor's own name.
fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    name.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}
