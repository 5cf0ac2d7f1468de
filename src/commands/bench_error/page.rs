//! The page: what was found in a sentence, two charts, the pictures, the figures. One file, nothing fetched.

use super::picture::{self, Part};
use super::report::Report;
use super::study::Reached;
use crate::markup::escape;
use anyhow::Result;
use glam::Vec3;
use std::fmt::Write;

const STYLE: &str = "
:root{--ink:#1d1d22;--soft:#6a6a74;--line:#e3e3e8;--card:#fff;--paper:#f6f6f4}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 Inter,'Helvetica Neue',Arial,sans-serif}
main{max-width:1240px;margin:0 auto;padding:44px 28px 80px}
h1{font-size:34px;line-height:1.18;margin:0 0 10px;letter-spacing:-.015em;max-width:24em}
h2{font-size:21px;margin:48px 0 14px}
p.lead{font-size:18px;color:var(--soft);margin:0 0 28px;max-width:56em}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(520px,1fr));gap:18px}
.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:14px;overflow:hidden}
.card svg{display:block;width:100%;height:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:14.5px}
th{font-weight:600;color:var(--soft);text-align:right;border-bottom:2px solid var(--line);padding:6px 10px;white-space:nowrap}
td{text-align:right;border-bottom:1px solid var(--line);padding:6px 10px;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
tr.next td{border-top:2px solid #c9c9d1}
td.best{font-weight:700}
.dot{display:inline-block;width:11px;height:11px;border-radius:50%;margin-right:8px}
.faint{color:var(--soft)}
.row{display:grid;grid-template-columns:1fr 1fr 1fr 1fr;gap:10px;margin-bottom:8px}
.row img{width:100%;display:block;border-radius:6px;background:#000}
.row img.crisp{image-rendering:pixelated}
figure{margin:0}
figcaption{font-size:13.5px;color:var(--soft);margin:4px 0 0}
h3{font-size:16px;margin:22px 0 8px}
dl{display:grid;grid-template-columns:max-content 1fr;gap:4px 20px;font-size:14.5px}
dt{color:var(--soft)}dd{margin:0}
.key{height:14px;border-radius:4px;background:linear-gradient(90deg,#c4e8ff,#1868eb 25%,#0e0e0e 50%,#f2600c 75%,#ffeebe);max-width:420px}
.keys{display:flex;justify-content:space-between;max-width:420px;font-size:13px;color:var(--soft)}
@media print{body{background:#fff}.card{break-inside:avoid}}
";

pub(super) fn html(report: &Report<'_>) -> Result<String> {
    let reached = report.reached();
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>domelight: error against time</title><style>{STYLE}</style></head><body><main>\n"
    );
    let (headline, lead) = headline(report, &reached);
    let _ = writeln!(out, "<h1>{}</h1><p class=\"lead\">{}</p>", escape(&headline), escape(&lead));
    let _ = writeln!(
        out,
        "<div class=\"charts\"><div class=\"card\">{}</div><div class=\"card\">{}</div></div>",
        report.by_time().svg(),
        report.by_rays().svg()
    );
    to_targets(&mut out, report, &reached);
    pictures(&mut out, report)?;
    figures(&mut out, report);
    out += "<h2>What was measured</h2><div class=\"card\"><dl>";
    for (key, value) in &report.facts {
        let _ = write!(out, "<dt>{key}</dt><dd>{}</dd>", escape(value));
    }
    let command: Vec<String> = std::env::args().collect();
    let _ = write!(out, "<dt>Command</dt><dd><code>{}</code></dd>", escape(&command.join(" ")));
    out += "</dl><p class=\"faint\">relMSE is the mean of (a − b)²/(b² + 0.01) over pixels and channels against the \
            reference. Time is CPU time of the whole process from the sampler's preparation to the last ray; loading and the \
            acceleration structure's build are the same for all and left out. Samplers take turns; points are medians, bars the \
            least and the greatest run. The ratio is image over reference, sum over sum: bias would show there.</p></div>\n";
    Ok(out + "</main></body></html>\n")
}

/// What was found, in a sentence.
fn headline(report: &Report<'_>, reached: &[Reached]) -> (String, String) {
    // The hardest target that some sampler reached in the study.
    let measured = |r: &&Reached| r.seconds.is_some() && !r.extrapolated;
    let target = reached.iter().filter(measured).map(|r| r.target).fold(f64::INFINITY, f64::min);
    let mut there: Vec<(&Reached, f64)> =
        reached.iter().filter(|r| r.target == target).filter_map(|r| Some((r, r.seconds?))).collect();
    there.sort_by(|a, b| a.1.total_cmp(&b.1));
    let images = format!("{} × {} pixels", report.args.size[0], report.args.size[1]);
    let what = format!("{}; {}. {images}.", report.facts[0].1, report.facts[1].1);
    match there[..] {
        [(first, seconds), .., (last, most)] => (
            format!("{} reaches a relMSE of {target} in {} of CPU time", first.sampler, time(seconds)),
            format!(
                "{}: {} times as long{}. {what}",
                last.sampler,
                figure(most / seconds),
                if last.extrapolated { " (extrapolated)" } else { "" }
            ),
        ),
        _ => ("Error against time and rays".to_owned(), what),
    }
}

fn time(seconds: f64) -> String {
    match seconds {
        s if s < 1.0 => format!("{} ms", figure(s * 1e3)),
        s => format!("{} s", figure(s)),
    }
}

/// Three digits, plainly.
fn figure(value: f64) -> String {
    let digits = (2.0 - value.abs().max(1e-9).log10().floor()).clamp(0.0, 8.0) as usize;
    format!("{value:.digits$}")
}

fn dot(report: &Report<'_>, sampler: &str) -> String {
    let index = report.samplers.iter().position(|s| s == sampler).unwrap_or_default();
    format!("<span class=\"dot\" style=\"background:{}\"></span>{}", report.color(index), escape(sampler))
}

fn to_targets(out: &mut String, report: &Report<'_>, reached: &[Reached]) {
    *out += "<h2>CPU seconds to an error</h2><div class=\"card\"><table><tr><th>sampler</th>";
    for target in &report.args.to_error {
        let _ = write!(out, "<th>relMSE {target}</th><th>× the best</th>");
    }
    *out += "<th>CPU ns a shadow ray</th><th>relMSE · s at most rays</th></tr>";
    for sampler in &report.samplers {
        let _ = write!(out, "<tr><td>{}</td>", dot(report, sampler));
        for target in &report.args.to_error {
            let at = |r: &&Reached| r.target == *target;
            let best = reached.iter().filter(at).filter_map(|r| r.seconds).fold(f64::INFINITY, f64::min);
            match reached
                .iter()
                .filter(at)
                .find(|r| r.sampler == *sampler)
                .and_then(|r| Some((r.seconds?, r.extrapolated)))
            {
                Some((s, beyond)) => {
                    let (class, mark) = (if s == best { " class=\"best\"" } else { "" }, if beyond { "~" } else { "" });
                    let _ = write!(out, "<td{class}>{mark}{}</td><td>{:.1}</td>", time(s), s / best);
                }
                None => *out += "<td>never</td><td></td>",
            }
        }
        let (ns, efficiency) = report.best(sampler).map_or((f64::NAN, f64::NAN), |r| (r.ns_a_ray, r.relmse_s));
        let _ = write!(out, "<td>{ns:.0}</td><td>{efficiency:.2e}</td></tr>");
    }
    *out +=
        "</table><p class=\"faint\">Straight lines between logarithms; ~ lies beyond what was measured.</p></div>\n";
}

/// Reference and renders, their differences, and a detail of both.
fn pictures(out: &mut String, report: &Report<'_>) -> Result<()> {
    if report.pictures.is_empty() {
        return Ok(());
    }
    let reference = &report.reference.pixels;
    let [width, height] = report.args.size.map(|side| side as usize);
    let whole = Part([0, 0, width, height]);
    let all: Vec<&[Vec3]> = report.pictures.iter().map(|(_, pixels)| &pixels[..]).collect();
    let detail = picture::detail(&all, reference, width, 6);
    let gain = gain(reference);
    // Full colour at the 98th percentile of the middling sampler: one scale for all.
    let mut scales: Vec<f32> = all.iter().map(|pixels| percentile(pixels, reference)).collect();
    scales.sort_by(f32::total_cmp);
    let most = scales[scales.len() / 2].max(1e-4);
    let [spp, rays] = report.args.largest();
    let _ = writeln!(
        out,
        "<h2>Where the error is, at {spp} × {rays} rays a pixel</h2><div class=\"card\">\
         <div class=\"key\"></div><div class=\"keys\"><span>{:.1} % too dark</span><span>right</span><span>{:.1} % too bright</span></div>",
        100.0 * most,
        100.0 * most
    );
    let img = |uri: String, class: &str| format!("<img class=\"{class}\" src=\"{uri}\" alt=\"\">");
    let _ = writeln!(
        out,
        "<h3>reference</h3><div class=\"row\"><figure>{}<figcaption>the whole picture</figcaption></figure>\
         <figure>{}<figcaption>the detail that is hardest</figcaption></figure></div>",
        img(picture::render(reference, width, whole, gain)?, ""),
        img(picture::render(reference, width, detail, gain)?, "crisp")
    );
    for (sampler, pixels) in &report.pictures {
        let row = report.rows.iter().find(|r| r.sampler == *sampler && [r.spp, r.rays] == [spp, rays]);
        let said = row.map_or_else(String::new, |r| format!("relMSE {:.2e} in {}", r.relmse, time(r.cpu_s)));
        let _ = writeln!(
            out,
            "<h3>{} <span class=\"faint\">{said}</span></h3><div class=\"row\">{}{}{}{}</div>",
            dot(report, sampler),
            img(picture::render(pixels, width, whole, gain)?, ""),
            img(picture::render(pixels, width, detail, gain)?, "crisp"),
            img(picture::differences(pixels, reference, width, whole, most)?, ""),
            img(picture::differences(pixels, reference, width, detail, most)?, "crisp")
        );
    }
    *out += "</div>\n";
    Ok(())
}

/// Brings the 90th percentile of what is lit to 0.7.
fn gain(reference: &[Vec3]) -> f32 {
    let mut values: Vec<f32> = reference.iter().map(|v| v.max_element()).filter(|v| *v > 0.0).collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() * 9 / 10).map_or(1.0, |v| 0.7 / v)
}

fn percentile(pixels: &[Vec3], reference: &[Vec3]) -> f32 {
    let mut values: Vec<f32> = pixels.iter().zip(reference).map(|(a, b)| picture::difference(*a, *b).abs()).collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() * 98 / 100).copied().unwrap_or(1.0)
}

fn figures(out: &mut String, report: &Report<'_>) {
    *out += "<h2>All figures</h2><div class=\"card\"><table><tr><th>sampler</th><th>budget</th><th>relMSE</th><th>runs</th>\
             <th>RMSE</th><th>CPU s</th><th>of it preparing</th><th>wall s</th><th>relMSE · s</th><th>M rays</th><th>ns a ray</th><th>ratio</th></tr>";
    let mut before = [0, 0];
    for r in &report.rows {
        let class = if before == [r.spp, r.rays] { "" } else { " class=\"next\"" };
        before = [r.spp, r.rays];
        let best = report.rows.iter().filter(|o| [o.spp, o.rays] == before).all(|o| o.relmse_s >= r.relmse_s);
        let _ = writeln!(
            out,
            "<tr{class}><td>{}</td><td>{} × {}</td><td>{:.2e}</td><td class=\"faint\">{:.2e} – {:.2e}</td><td>{:.2e}</td><td>{:.3}</td>\
             <td>{:.3}</td><td>{:.3}</td><td{}>{:.2e}</td><td>{:.2}</td><td>{:.0}</td><td>{:.4} ± {:.4}</td></tr>",
            dot(report, &r.sampler),
            r.spp,
            r.rays,
            r.relmse,
            r.relmse_range[0],
            r.relmse_range[1],
            r.rmse,
            r.cpu_s,
            r.prepare_s,
            r.wall_s,
            if best { " class=\"best\"" } else { "" },
            r.relmse_s,
            r.shadow_rays as f64 * 1e-6,
            r.ns_a_ray,
            r.ratio,
            r.ratio_error
        );
    }
    *out += "</table></div>\n";
}
