//! Plugins by name. A plugin is one file and one line in the `const` slice of its kind; its options are one static list
//! that drives the parser, `domelight plugins`, the README's table and the image's metadata.
//!
//! The notation is `name:key=value,key=value` everywhere. An unknown name, an unknown key, a value out of range or a key
//! given twice is an error that lists what is known.

use crate::error::{Error, Result};
use std::fmt;

/// One plugin of a kind whose constructors have type `M`.
#[derive(Debug)]
pub struct Plugin<M: 'static> {
    /// The name it is chosen by.
    pub name: &'static str,
    /// One line for the list.
    pub about: &'static str,
    /// Its options.
    pub options: &'static [Opt],
    /// Its constructor.
    pub make: M,
}

/// One option of a plugin.
#[derive(Debug)]
pub struct Opt {
    /// The key.
    pub key: &'static str,
    /// What values it takes.
    pub kind: Kind,
    /// The default, written as a user would write it (`auto` is allowed for numbers).
    pub default: &'static str,
    /// One line for the list.
    pub about: &'static str,
}

/// What values an option takes. Ranges are inclusive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// `on`/`true`/`yes`/`1` or `off`/`false`/`no`/`0`.
    Switch,
    /// A whole number.
    Integer(u64, u64),
    /// A finite number.
    Number(f64, f64),
    /// One of these words.
    Choice(&'static [&'static str]),
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Switch => write!(f, "on|off"),
            Self::Integer(low, high) => write!(f, "{low}..{high}"),
            Self::Number(low, high) => write!(f, "{low}..{high}"),
            Self::Choice(words) => write!(f, "{}", words.join("|")),
        }
    }
}

/// A plugin's resolved options, defaults filled in. Displays as the specification that would give it again.
#[derive(Debug, Clone, PartialEq)]
pub struct Params {
    name: &'static str,
    values: Vec<(&'static str, Value)>,
}

#[derive(Debug, Clone, PartialEq)]
enum Value {
    Auto,
    Switch(bool),
    Integer(u64),
    Number(f64),
    Word(String),
}

impl Params {
    fn value(&self, key: &str) -> &Value {
        let found = self.values.iter().find(|(k, _)| *k == key);
        &found.unwrap_or_else(|| panic!("plugin {} asks for an option it does not declare: {key}", self.name)).1
    }
    /// The plugin's name.
    pub fn name(&self) -> &'static str {
        self.name
    }
    /// A [`Kind::Switch`].
    pub fn switch(&self, key: &str) -> bool {
        matches!(self.value(key), Value::Switch(true))
    }
    /// A [`Kind::Integer`], `None` for `auto`.
    pub fn integer(&self, key: &str) -> Option<u64> {
        if let Value::Integer(v) = self.value(key) { Some(*v) } else { None }
    }
    /// A [`Kind::Number`], `None` for `auto`.
    pub fn number(&self, key: &str) -> Option<f64> {
        if let Value::Number(v) = self.value(key) { Some(*v) } else { None }
    }
    /// A [`Kind::Choice`].
    pub fn word(&self, key: &str) -> &str {
        if let Value::Word(w) = self.value(key) { w } else { "auto" }
    }
}

impl fmt::Display for Params {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.name)?;
        for (i, (key, value)) in self.values.iter().enumerate() {
            write!(f, "{}{key}=", if i == 0 { ":" } else { "," })?;
            match value {
                Value::Auto => write!(f, "auto")?,
                Value::Switch(on) => write!(f, "{}", if *on { "on" } else { "off" })?,
                Value::Integer(v) => write!(f, "{v}")?,
                Value::Number(v) => write!(f, "{v}")?,
                Value::Word(w) => write!(f, "{w}")?,
            }
        }
        Ok(())
    }
}

/// Finds the plugin that `spec` (`name:key=value,…`) names and resolves its options. `kind` is the word for messages.
pub fn resolve<'a, M>(kind: &str, plugins: &'a [Plugin<M>], spec: &str) -> Result<(&'a Plugin<M>, Params)> {
    let (name, rest) = spec.split_once(':').unwrap_or((spec, ""));
    let plugin = plugins.iter().find(|p| p.name == name).ok_or_else(|| {
        let known: Vec<_> = plugins.iter().map(|p| p.name).collect();
        Error::Option(format!("unknown {kind} '{name}'; known: {}", known.join(", ")))
    })?;
    let mut given: Vec<(&str, &str)> = Vec::new();
    for part in rest.split(',').filter(|p| !p.is_empty()) {
        // A bare word sets the switch of that name, or picks the choice that has it: `latlong:mis`.
        let pair = match part.split_once('=') {
            Some(pair) => pair,
            None => match plugin.options.iter().find(|o| matches!(o.kind, Kind::Choice(w) if w.contains(&part))) {
                Some(option) => (option.key, part),
                None => (part, "on"),
            },
        };
        if given.iter().any(|(key, _)| *key == pair.0) {
            return Err(Error::Option(format!("{kind} {name}: '{}' is given twice in '{spec}'", pair.0)));
        }
        if !plugin.options.iter().any(|o| o.key == pair.0) {
            let known: Vec<_> = plugin.options.iter().map(|o| format!("{}={}", o.key, o.kind)).collect();
            let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            return Err(Error::Option(format!("{kind} {name}: unknown option '{}'; known: {known}", pair.0)));
        }
        given.push(pair);
    }
    let mut values = Vec::with_capacity(plugin.options.len());
    for option in plugin.options {
        let text = given.iter().find(|(key, _)| *key == option.key).map_or(option.default, |(_, v)| v);
        values.push((option.key, parse(kind, name, option, text)?));
    }
    Ok((plugin, Params { name: plugin.name, values }))
}

fn parse(kind: &str, plugin: &str, option: &Opt, text: &str) -> Result<Value> {
    if text == "auto" && option.default == "auto" {
        return Ok(Value::Auto);
    }
    let value = match option.kind {
        Kind::Switch => match text {
            "on" | "true" | "yes" | "1" => Some(Value::Switch(true)),
            "off" | "false" | "no" | "0" => Some(Value::Switch(false)),
            _ => None,
        },
        Kind::Integer(low, high) => text.parse().ok().filter(|v| (low..=high).contains(v)).map(Value::Integer),
        Kind::Number(low, high) => {
            text.parse().ok().filter(|v: &f64| v.is_finite() && (low..=high).contains(v)).map(Value::Number)
        }
        Kind::Choice(words) => words.contains(&text).then(|| Value::Word(text.to_owned())),
    };
    value.ok_or_else(|| {
        let auto = if option.default == "auto" { " or auto" } else { "" };
        Error::Option(format!("{kind} {plugin}: {}={text} is not in {}{auto}", option.key, option.kind))
    })
}

/// The plugins of a kind as lines of text: name, what it is, its options with range and default.
pub fn describe<M>(plugins: &[Plugin<M>]) -> String {
    let mut text = String::new();
    for p in plugins {
        text += &format!("  {:<12} {}\n", p.name, p.about);
        for o in p.options {
            let left = format!("{}={}", o.key, o.kind);
            text += &format!("    {left:<30} {} (default {})\n", o.about, o.default);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const THINGS: &[Plugin<()>] = &[Plugin {
        name: "thing",
        about: "a thing",
        options: &[
            Opt { key: "size", kind: Kind::Integer(1, 8), default: "auto", about: "how large" },
            Opt { key: "fast", kind: Kind::Switch, default: "off", about: "whether fast" },
            Opt { key: "gain", kind: Kind::Number(0.0, 1.0), default: "0.5", about: "how much" },
            Opt { key: "mode", kind: Kind::Choice(&["plain", "seed"]), default: "plain", about: "which form" },
        ],
        make: (),
    }];

    #[test]
    fn resolved_options_display_as_the_specification_that_gives_them_again() {
        let (_, params) = resolve("thing", THINGS, "thing:size=3,fast,seed").unwrap();
        assert_eq!((params.integer("size"), params.switch("fast"), params.word("mode")), (Some(3), true, "seed"));
        let again = resolve("thing", THINGS, &params.to_string()).unwrap().1;
        assert_eq!(params, again);
        assert_eq!(resolve("thing", THINGS, "thing").unwrap().1.integer("size"), None);
    }

    #[test]
    fn what_is_wrong_is_named_with_what_is_known() {
        for (spec, says) in [
            ("other", "known: thing"),
            ("thing:weight=1", "known: size=1..8"),
            ("thing:size=0", "not in 1..8 or auto"),
            ("thing:size=99999999999999999999", "not in 1..8"),
            ("thing:gain=NaN", "not in 0..1"),
            ("thing:gain=0.1,gain=0.2", "given twice"),
            ("thing:fast=perhaps", "on|off"),
        ] {
            let error = resolve("thing", THINGS, spec).unwrap_err().to_string();
            assert!(error.contains(says), "{spec}: {error}");
        }
    }
}
