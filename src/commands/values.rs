//! Values of options: whatever is wrong with one, the message names what is allowed.

use std::ops::RangeInclusive;

/// A whole number within a range.
pub(crate) fn whole<T: TryFrom<u64> + Clone + Send + Sync + 'static>(
    range: RangeInclusive<u64>,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static {
    move |text| {
        let value = text.parse().ok().filter(|value| range.contains(value)).and_then(|value| T::try_from(value).ok());
        value.ok_or_else(|| format!("a whole number from {} to {} is wanted", range.start(), range.end()))
    }
}

/// A number within a range.
pub(crate) fn number(
    range: RangeInclusive<f64>,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text| {
        let value = text.parse().ok().filter(|value| range.contains(value));
        value.ok_or_else(|| format!("a number from {} to {} is wanted", range.start(), range.end()))
    }
}

/// A finite number above 0.
pub(crate) fn positive(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|value: &f64| *value > 0.0 && value.is_finite());
    value.ok_or_else(|| "a number above 0 is wanted".to_owned())
}

/// A finite number.
pub(crate) fn finite(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|value: &f64| value.is_finite());
    value.ok_or_else(|| "a finite number is wanted".to_owned())
}

/// Bytes: `2000000`, `512M`, `1.5G` (powers of 1024; `MiB`, `GB` and the like mean the same).
pub(crate) fn bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let factor = match text[digits.len()..].to_ascii_uppercase().trim_end_matches('B').trim_end_matches('I') {
        "" => Some(0),
        "K" => Some(10),
        "M" => Some(20),
        "G" => Some(30),
        "T" => Some(40),
        _ => None,
    };
    let bytes = factor.zip(digits.parse::<f64>().ok()).map(|(shift, value)| value * (1u64 << shift) as f64);
    let range = (1u64 << 20) as f64..=(1u64 << 50) as f64;
    let bytes = bytes.filter(|bytes| range.contains(bytes));
    bytes.map(|bytes| bytes as u64).ok_or_else(|| "a size such as 512M or 8G is wanted, from 1M to 1024T".to_owned())
}

#[cfg(test)]
mod tests {
    #[test]
    fn sizes_of_memory() {
        for (text, value) in
            [("1048576", 1 << 20), ("2M", 2 << 20), ("1.5GiB", 3 << 29), ("8GB", 8 << 30), ("1T", 1 << 40)]
        {
            assert_eq!(super::bytes(text), Ok(value), "{text}");
        }
        for text in ["", "0", "-1G", "1", "NaN", "infG", "1X", "G", "1e99G", "2000T", "1 G"] {
            assert!(super::bytes(text).unwrap_err().contains("512M"), "{text}");
        }
    }
}
