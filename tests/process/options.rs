//! Every option and every plugin parameter given zero, negatives, NaN, overflow and unknown words: exit code 2, one
//! message that names the option and what is allowed, before anything is loaded.

use crate::support::{domelight, repo};
use domelight::accel::ACCELS;
use domelight::integrator::INTEGRATORS;
use domelight::registry::{Kind, Opt, Plugin};
use domelight::sampler::SAMPLERS;
use rayon::prelude::*;

const WORDS: [&str; 3] = ["", "NaN", "many"];
const HUGE: [&str; 1] = ["99999999999999999999e999"];

/// Option, values that are refused beside [`WORDS`] and [`HUGE`], what the message names.
type Case = (&'static str, &'static [&'static str], &'static str);

const RENDER: &[Case] = &[
    ("--size", &["0x4", "4x0", "-1x4", "65537x1", "4x", "4", "65536x65536", "4x4x4", "4.5x4"], "from 1 to 65536"),
    ("--crop", &["0,0,0,4", "1,0,4,4", "0,0,4", "-1,0,4,4", "4294967295,0,4,4", "0,0,4,4,4"], "image"),
    ("--spp", &["0", "-1", "1048577", "1.5"], "from 1 to 1048576"),
    ("--rays", &["0", "-1", "65537", "1.5"], "from 1 to 65536"),
    ("--time", &["0", "-1", "inf"], "above 0"),
    ("--seed", &["-1", "4294967296", "0.5"], "from 0 to 4294967295"),
    ("--filter", &["0", "boxes"], "box, blackman-harris"),
    ("--aov", &["0", "mood", "albedo,"], "albedo, normal, depth, position, visibility"),
    ("--background", &["0", "white"], "dome, black, transparent"),
    ("--tonemap", &["0", "filmic"], "neutral, aces, none"),
    ("--exposure", &["-33", "33", "inf"], "from -32 to 32"),
    ("--dome-rotate", &["inf", "-inf"], "finite"),
    ("--dome-scale", &["0", "-1", "inf"], "above 0"),
    ("--fov", &["0", "-1", "180", "0.009", "inf"], "from 0.01 to 179"),
    ("--orbit", &["0", "0,0,0", "0,0,-1", "inf,0", "0,0,1,1"], "AZ,EL"),
    ("--target", &["0", "0,0", "0,0,inf"], "finite number"),
    ("--threads", &["0", "-1", "1025"], "from 1 to 1024"),
    ("--tile", &["0", "-1", "4097"], "from 1 to 4096"),
    ("--checkpoint-every", &["-1", "inf", "1000001"], "from 0 to 1000000"),
    ("--max-memory", &["0", "-1G", "1", "1X", "2000T"], "from 1M to 1024T"),
    ("--progress", &["0", "loud"], "auto, bar, plain, json, none"),
    ("--accel", &["0", "magic"], "bvh"),
    ("--sampler", &["0", "magic", "tessellated:cache=off,cache=off"], "tessellated"),
    ("--integrator", &["0", "magic"], "direct"),
];

const BENCH_ERROR: &[Case] = &[
    ("--size", &["0x4", "-1x4"], "from 1 to 65536"),
    ("--budgets", &["0x4", "4x0", "4", "-4x4", "32769x1", "4x4,0x1"], "from 1 to 32768"),
    ("--repeat", &["0", "-1", "1001"], "from 1 to 1000"),
    ("--to-error", &["0", "-1", "inf"], "above 0"),
    ("--reference-rays", &["31", "-1", "16777217"], "from 32 to 16777216"),
    ("--threads", &["0", "-1", "1025"], "from 1 to 1024"),
    ("--sampler", &["magic"], "tessellated"),
    ("--reference-sampler", &["magic"], "tessellated"),
    ("--dome-scale", &["0", "-1"], "above 0"),
];

const BENCH_RAYS: &[Case] = &[
    ("--rays", &["0", "255", "-1", "67108865"], "from 256 to 67108864"),
    ("--rounds", &["0", "-1", "1001"], "from 1 to 1000"),
    ("--threads", &["0", "1,-1", "1025"], "from 1 to 1024"),
    ("--generate", &["terrain", "terrain:0", "terrain:-1", "terrain:101M", "moon:10k", "terrain:1e3"], "terrain"),
    ("--accel", &["magic"], "bvh"),
];

const COMPARE: &[Case] = &[("--max-relmse", &["-1", "-inf"], "≥ 0"), ("--max-flip", &["-1", "-inf"], "≥ 0")];

/// Runs `command` with each option at each bad value; several processes at a time.
fn refused(command: &[String], cases: &[Case]) {
    let all: Vec<_> =
        cases.iter().flat_map(|case| case.1.iter().chain(&WORDS).chain(&HUGE).map(move |v| (case, *v))).collect();
    all.par_iter().for_each(|((option, _, says), value)| {
        // An option that takes a list may be given an empty one.
        let assert = domelight().args(command).arg(format!("{option}={value}")).assert();
        let output = assert.get_output();
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{option}={value}: {error}");
        assert!(error.contains(says) || (value.is_empty() && error.contains(option)), "{option}={value}: {error}");
        assert!(!error.contains("panicked"), "{option}={value}: {error}");
    });
}

/// A render that would be long, so that one that begins is noticed.
fn base() -> Vec<String> {
    let [scene, dome] = ["scenes/materials.glb", "scenes/window.exr"].map(|path| repo(path).display().to_string());
    let text = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let folder = std::env::temp_dir().join("domelight-options-test.exr").display().to_string();
    [
        text(&["render"]),
        vec![scene, "--dome".to_owned(), dome, "-o".to_owned(), folder],
        text(&["--checkpoint", "/tmp/domelight-options-test"]),
    ]
    .concat()
}

#[test]
fn options_of_render() {
    let mut command = base();
    let small = RENDER.iter().filter(|case| case.0 != "--size").copied().collect::<Vec<_>>();
    refused(&command, &RENDER[..1]);
    command.extend(["--size", "4x4"].map(str::to_owned));
    refused(&command, &small);
    // Two that are asked for together.
    for (option, value) in [("--eye", "0,0"), ("--eye", "NaN,0,0"), ("--eye", "0,0,inf"), ("--look-at", "1e999,0,0")] {
        let other = if option == "--eye" { "--look-at=0,0,0" } else { "--eye=0,0,1" };
        let assert = domelight().args(&command).arg(format!("{option}={value}")).arg(other).assert().code(2);
        let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
        assert!(error.contains("finite number") || error.contains("three numbers"), "{option}={value}: {error}");
    }
    let assert = domelight().args(&command).args(["--eye=1,2,3", "--look-at=1,2,3"]).assert().code(2);
    let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
    assert!(error.contains("two different points"), "{error}");
}

#[test]
fn options_of_the_other_commands() {
    let render = base();
    let [scene, dome] = [&render[1], &render[3]];
    let command = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    refused(&command(&["bench", "error", scene, "--dome", dome]), BENCH_ERROR);
    refused(&command(&["bench", "rays"]), BENCH_RAYS);
    refused(&command(&["compare", dome, dome]), COMPARE);
    refused(&command(&["inspect", dome]), &[("--normal", &["0", "0,0", "0,0,inf"], "finite number")]);
    refused(&command(&["inspect", dome, "--normal=0,0,0"]), &[("--sampler", &["magic"], "tessellated")]);
}

/// Values outside of an option's range, and words of no meaning.
fn wrong(option: &Opt) -> Vec<String> {
    let mut all: Vec<String> = ["", "NaN", "inf", "-1", "99999999999999999999"].map(str::to_owned).to_vec();
    match option.kind {
        Kind::Integer(low, high) => {
            all.extend([low.wrapping_sub(1).to_string(), (high + 1).to_string(), "1.5".to_owned()])
        }
        Kind::Number(low, high) => {
            all.retain(|value| value != "-1" || low > -1.0);
            all.extend([(low - 1.0).to_string(), (high + 1.0).to_string()]);
        }
        Kind::Switch | Kind::Choice(_) => all.push("2".to_owned()),
    }
    all
}

fn parameters<M: Sync>(kind: &str, plugins: &[Plugin<M>]) {
    let mut command = base();
    command.extend(["--size", "4x4"].map(str::to_owned));
    for plugin in plugins {
        let mut cases: Vec<(String, String)> = vec![
            (format!("{}:nonsense=1", plugin.name), "unknown option".into()),
            (format!("{}:=1", plugin.name), "unknown option".into()),
        ];
        for option in plugin.options {
            cases.extend(wrong(option).into_iter().map(|value| {
                (format!("{}:{}={value}", plugin.name, option.key), format!("is not in {}", option.kind))
            }));
        }
        cases.par_iter().for_each(|(spec, says)| {
            let assert = domelight().args(&command).arg(format!("{kind}={spec}")).assert().code(2);
            let error = String::from_utf8_lossy(&assert.get_output().stderr).into_owned();
            assert!(error.contains(says.as_str()), "{kind}={spec}: {error}");
        });
    }
}

#[test]
fn parameters_of_plugins() {
    parameters("--accel", ACCELS);
    parameters("--sampler", SAMPLERS);
    parameters("--integrator", INTEGRATORS);
}
