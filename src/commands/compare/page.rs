//! A page that holds both pictures, their difference and the figures in one file, with a slider to wipe from one picture
//! to the other. No script from elsewhere, no picture beside it: it can be mailed or kept as a CI artifact.

use super::pair::{Figures, Pair};
use crate::markup::{data_uri, escape};
use crate::ramp;
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
        data_uri(&bytes, pair.width)
    };
    let [a, b] = [shown(&pair.images[0])?, shown(&pair.images[1])?];
    let heat: Vec<u8> = map.iter().flat_map(|v| ramp::colour(*v)).collect();
    let difference = data_uri(&heat, pair.width)?;
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
         <div class=stack><img id=a alt='image' src='{a}'>\
         <img id=b alt='reference' src='{b}'>\
         <img id=d alt='HDR-FLIP' src='{difference}'></div>\
         <p><label><input type=checkbox id=diff> difference (HDR-FLIP, black 0 to pale yellow 1)</label>. Left of the \
         slider the image, right of it the reference; <kbd>f</kbd> flips, <kbd>d</kbd> shows the difference.</p>\
         <script>{SCRIPT}</script></html>\n",
        names[0], names[1]
    ))
}
