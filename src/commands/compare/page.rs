//! A page that holds both pictures, their difference and the figures in one file, with a slider to wipe from one picture
//! to the other. No script from elsewhere, no picture beside it: it can be mailed or kept as a CI artifact.

use super::pair::{Figures, Pair};
use super::ramp;
use anyhow::Result;
use domelight::output::tonemap::{Curve, srgb_byte};
use glam::Vec3;
use std::fmt::Write;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;\
background:#16181d;color:#e8e8e8}table{border-collapse:collapse;margin:1rem 0}td{padding:.1rem 1rem .1rem 0}\
td:last-child{font-family:ui-monospace,monospace}.over{color:#ff8a70}.ok{color:#8fd694}\
.stack{position:relative;display:inline-block;max-width:100%}.stack img{display:block;max-width:100%;image-rendering:pixelated}\
#b,#d{position:absolute;left:0;top:0}#d{display:none}input[type=range]{width:100%}kbd{border:1px solid #888;\
border-radius:3px;padding:0 .3em}";

const SCRIPT: &str = "const $=i=>document.getElementById(i),s=$('s');\
function wipe(){$('b').style.clipPath=`inset(0 0 0 ${s.value}%)`}s.oninput=wipe;wipe();\
$('diff').onchange=e=>$('d').style.display=e.target.checked?'block':'none';\
document.onkeydown=e=>{if(e.key=='f'){s.value=s.value>50?0:100;wipe()}\
if(e.key=='d'){$('diff').click()}};";

/// The page as text.
pub(super) fn page(pair: &Pair, figures: &Figures, broken: &[String], map: &[f32]) -> Result<String> {
    let shown = |picture: &[Vec3]| -> Result<String> {
        let bytes: Vec<u8> = picture.iter().flat_map(|c| Curve::Neutral.apply(*c).to_array().map(srgb_byte)).collect();
        Ok(base64(&ramp::encode(&bytes, pair.width)?))
    };
    let [a, b] = [shown(&pair.images[0])?, shown(&pair.images[1])?];
    let difference = base64(&ramp::png(map, pair.width)?);
    let names = [escape(&pair.names[0]), escape(&pair.names[1])];
    let mut rows = String::new();
    for (name, value) in figures.rows() {
        write!(rows, "<tr><td>{name}</td><td>{}</td></tr>", escape(&value))?;
    }
    let verdict = if broken.is_empty() {
        "<p class=ok>Within the limits.</p>".to_owned()
    } else {
        format!("<p class=over>Over the limit: {}</p>", escape(&broken.join("; ")))
    };
    Ok(format!(
        "<!doctype html><html lang=en><meta charset=utf-8><title>domelight compare</title><style>{STYLE}</style>\
         <h1>{} <small>against</small> {}</h1>{verdict}<table>{rows}</table>\
         <p><input type=range id=s min=0 max=100 value=50 aria-label='wipe from the image to the reference'></p>\
         <div class=stack><img id=a alt='image' src='data:image/png;base64,{a}'>\
         <img id=b alt='reference' src='data:image/png;base64,{b}'>\
         <img id=d alt='HDR-FLIP' src='data:image/png;base64,{difference}'></div>\
         <p><label><input type=checkbox id=diff> difference (HDR-FLIP, black 0 to pale yellow 1)</label>. Left of the \
         slider the image, right of it the reference; <kbd>f</kbd> flips, <kbd>d</kbd> shows the difference.</p>\
         <script>{SCRIPT}</script></html>\n",
        names[0], names[1]
    ))
}

/// Text for HTML and XML, attribute values included; characters XML can't hold become U+FFFD.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c if c < ' ' && !matches!(c, '\n' | '\t') => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let word = group.iter().fold(0u32, |w, b| w << 8 | u32::from(*b)) << (8 * (3 - group.len()));
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k) & 63) as usize];
            text.push(if k <= group.len() { digit as char } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_of_the_standards_examples() {
        for (bytes, text) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }
}
