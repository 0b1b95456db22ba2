// SPDX-License-Identifier: MIT OR Apache-2.0
//! Metrics as data: one structure, shown as Prometheus text and as JSON.

use crate::base::histogram::Histogram;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use utoipa::ToSchema;

/// What kind of numbers a family has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Grows; begins anew with each session or process.
    Counter,
    /// A value that goes up and down.
    Gauge,
    /// Durations, counted in classes of their length.
    Histogram,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// All values of one metric, one for each combination of labels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Family {
    /// With its unit at the end, as Prometheus names things.
    pub name: String,
    /// What the metric measures, in one sentence.
    pub help: String,
    /// Whether it is a counter, a gauge or a histogram.
    pub kind: Kind,
    /// One for each combination of labels.
    pub samples: Vec<Sample>,
}

/// One number, or one histogram.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Sample {
    /// Labels and their values, such as the camera's name.
    pub labels: BTreeMap<String, String>,
    /// The number; of a histogram, how many durations were counted.
    pub value: f64,
    /// The classes of a histogram; none for counters and gauges.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distribution: Option<Distribution>,
}

/// Durations, counted in cumulative classes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Distribution {
    /// The classes by their upper bound, s; each includes the shorter ones.
    pub buckets: Vec<Bucket>,
    /// The sum of all, s.
    pub sum: f64,
}

/// One class of a histogram, which includes all shorter ones.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Bucket {
    /// The upper bound of the class, s.
    pub le: f64,
    /// How many were not longer.
    pub count: u64,
}

/// Bounds of the classes that are shown: 2^8 us to 2^24 us, a quarter of a millisecond to 17 s.
const EXPONENTS: std::ops::RangeInclusive<u32> = 8..=24;

impl Sample {
    /// A single value with its labels.
    pub fn new(labels: &[(&str, &str)], value: f64) -> Self {
        let labels = labels.iter().map(|(name, text)| ((*name).to_owned(), (*text).to_owned())).collect();
        Self { labels, value, distribution: None }
    }

    /// The classes of a histogram, with labels.
    pub fn of(labels: &[(&str, &str)], histogram: &Histogram) -> Self {
        let counts = histogram.below_powers_of_two(EXPONENTS);
        let bucket = |(exponent, count)| Bucket { le: f64::from(exponent).exp2() / 1e6, count };
        let buckets: Vec<Bucket> = EXPONENTS.zip(counts).map(bucket).collect();
        let sum = histogram.sum_us() as f64 / 1e6;
        // Counted after the classes: what came in between is in none of them, and longer than none.
        let count = histogram.count() as f64;
        Self { distribution: Some(Distribution { buckets, sum }), ..Self::new(labels, count) }
    }
}

impl Family {
    /// A family with these samples.
    pub fn new(name: &str, help: &str, kind: Kind, samples: Vec<Sample>) -> Self {
        Self { name: name.to_owned(), help: help.to_owned(), kind, samples }
    }

    /// A family of one number without labels: its name, help, kind and value.
    pub fn single((name, help, kind, value): (&str, &str, Kind, f64)) -> Self {
        Self::new(name, help, kind, vec![Sample::new(&[], value)])
    }
}

/// The text format of Prometheus, version 0.0.4.
pub fn text(families: &[Family]) -> String {
    let mut out = String::new();
    for family in families {
        let Family { name, kind, samples, help } = family;
        // Writing into a String cannot fail.
        let _ = writeln!(
            out,
            "# HELP {name} {}\n# TYPE {name} {kind}",
            help.replace('\\', "\\\\").replace('\n', "\\n")
        );
        for Sample { labels, value, distribution } in samples {
            let Some(Distribution { buckets, sum }) = distribution else {
                let _ = writeln!(out, "{name}{} {value}", Labels(labels, None));
                continue;
            };
            for Bucket { le, count } in buckets {
                let _ = writeln!(out, "{name}_bucket{} {count}", Labels(labels, Some(&le.to_string())));
            }
            let _ = writeln!(out, "{name}_bucket{} {value}", Labels(labels, Some("+Inf")));
            let _ = writeln!(
                out,
                "{name}_sum{} {sum}\n{name}_count{} {value}",
                Labels(labels, None),
                Labels(labels, None)
            );
        }
    }
    out
}

struct Labels<'a>(&'a BTreeMap<String, String>, Option<&'a str>);

impl fmt::Display for Labels<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let labels = self.0.iter().map(|(name, text)| (name.as_str(), text.as_str()));
        let labels: Vec<String> = labels
            .chain(self.1.map(|le| ("le", le)))
            .map(|(name, text)| {
                let text = text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
                format!("{name}=\"{text}\"")
            })
            .collect();
        if labels.is_empty() { Ok(()) } else { write!(f, "{{{}}}", labels.join(",")) }
    }
}

#[cfg(test)]
mod tests {
    use super::{Family, Kind, Sample, text};
    use crate::base::histogram::Histogram;
    use std::time::Duration;

    #[test]
    fn the_text_is_what_prometheus_reads() {
        let histogram = Histogram::default();
        [100, 300, 3_000_000, 60_000_000]
            .into_iter()
            .for_each(|us| histogram.record(Duration::from_micros(us)));
        let families = [
            Family::new(
                "a_total",
                "One\nline.",
                Kind::Counter,
                vec![Sample::new(&[("camera", "h\"0\\")], 3.0)],
            ),
            Family::new(
                "b_seconds",
                "Times.",
                Kind::Histogram,
                vec![Sample::of(&[("stage", "x")], &histogram)],
            ),
        ];
        let text = text(&families);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            &lines[..3],
            ["# HELP a_total One\\nline.", "# TYPE a_total counter", "a_total{camera=\"h\\\"0\\\\\"} 3"]
        );
        assert_eq!(lines[5], "b_seconds_bucket{stage=\"x\",le=\"0.000256\"} 1");
        assert_eq!(lines[6], "b_seconds_bucket{stage=\"x\",le=\"0.000512\"} 2");
        assert!(lines.contains(&"b_seconds_bucket{stage=\"x\",le=\"4.194304\"} 3"), "{text}");
        assert_eq!(
            &lines[lines.len() - 3..],
            [
                "b_seconds_bucket{stage=\"x\",le=\"+Inf\"} 4",
                "b_seconds_sum{stage=\"x\"} 63.0004",
                "b_seconds_count{stage=\"x\"} 4"
            ]
        );
    }
}
