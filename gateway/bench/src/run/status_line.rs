//! The text of a run's progress line, for any line width.

use protocol::usage::printable;

/// Duration in s from which a run counts as endless.
const ENDLESS_DURATION_S: f64 = 86_400.0;

/// Values of a run's progress line.
#[derive(Clone, Debug)]
pub(super) struct StatusLine<'a> {
    /// Time since the start of the loop in s.
    pub(super) elapsed_s: f64,
    /// Duration of the run in s.
    pub(super) duration_s: f64,
    /// Names of the lost buses.
    pub(super) lost: &'a [&'a str],
    /// Reason of the present halt, if any.
    pub(super) halted: Option<&'a str>,
    /// Number of cells in contact.
    pub(super) contributing: u32,
    /// Number of cells of the skin.
    pub(super) cells: usize,
    /// Number of cells in contact that missed the last epoch.
    pub(super) stale: u32,
    /// Number of dead cells.
    pub(super) dead: u32,
    /// 99th percentile of the ticks' lateness in µs.
    pub(super) late_us: f64,
    /// Name of the gateway's computation mode.
    pub(super) mode: &'static str,
    /// Torque on each joint in Nm.
    pub(super) torque_nm: &'a [f64],
}

/// Level of detail of each part of a progress line: 0 omits the part or selects its shortest form.
#[derive(Clone, Copy)]
struct DetailLevels {
    time: u8,
    alarm: u8,
    contact: u8,
    late: u8,
    mode: u8,
    torque: u8,
}

/// Details of the lines, longest first. Less important parts are dropped first.
const DETAIL_CHOICES: [DetailLevels; 12] = [
    DetailLevels { time: 1, alarm: 1, contact: 3, late: 1, mode: 1, torque: 2 },
    DetailLevels { time: 1, alarm: 1, contact: 3, late: 1, mode: 0, torque: 2 },
    DetailLevels { time: 1, alarm: 1, contact: 3, late: 0, mode: 0, torque: 2 },
    DetailLevels { time: 1, alarm: 1, contact: 2, late: 0, mode: 0, torque: 2 },
    DetailLevels { time: 1, alarm: 1, contact: 1, late: 0, mode: 0, torque: 2 },
    DetailLevels { time: 1, alarm: 1, contact: 1, late: 0, mode: 0, torque: 1 },
    DetailLevels { time: 1, alarm: 0, contact: 1, late: 0, mode: 0, torque: 1 },
    DetailLevels { time: 1, alarm: 0, contact: 0, late: 0, mode: 0, torque: 1 },
    DetailLevels { time: 0, alarm: 0, contact: 0, late: 0, mode: 0, torque: 1 },
    DetailLevels { time: 1, alarm: 0, contact: 1, late: 0, mode: 0, torque: 0 },
    DetailLevels { time: 1, alarm: 0, contact: 0, late: 0, mode: 0, torque: 0 },
    DetailLevels { time: 0, alarm: 0, contact: 0, late: 0, mode: 0, torque: 0 },
];

impl StatusLine<'_> {
    /// Returns the text for a line of `width` columns: the most detailed text that fits, or the shortest if none fits;
    /// without a width, the full text. All texts contain the torque.
    pub(super) fn text(&self, width: Option<usize>) -> String {
        let fits = |text: &String| width.is_none_or(|width| text.chars().count() <= width);
        let mut texts = DETAIL_CHOICES.into_iter().map(|detail| self.text_with_details(detail));
        let first = texts.find(fits);
        first.unwrap_or_else(|| {
            DETAIL_CHOICES.last().map_or_else(String::new, |detail| self.text_with_details(*detail))
        })
    }

    fn text_with_details(&self, detail: DetailLevels) -> String {
        let late = (detail.late > 0).then(|| format!("tick lateness p99 {:.0} µs", self.late_us));
        let mode = (detail.mode > 0).then(|| format!("{:11}", self.mode));
        let parts = [
            Some(self.time_text(detail.time)),
            self.lost_buses_text(detail.alarm),
            self.halt_text(detail.alarm),
            self.contact_text(detail.contact),
            late,
            mode,
            Some(self.torque_text(detail.torque)),
        ];
        parts.into_iter().flatten().collect::<Vec<_>>().join("  ")
    }

    fn time_text(&self, detail: u8) -> String {
        let (elapsed, duration) = (self.elapsed_s, self.duration_s);
        let has_end = detail > 0 && duration < ENDLESS_DURATION_S;
        if has_end { format!("{elapsed:5.1} of {duration:.1} s") } else { format!("{elapsed:5.1} s") }
    }

    fn lost_buses_text(&self, detail: u8) -> Option<String> {
        match (self.lost, detail) {
            ([], _) => None,
            (lost, 0) => Some(format!("LOST: {}", lost.len())),
            (lost, _) => Some(format!("LOST: {}", printable(&lost.join(", ")))),
        }
    }

    fn halt_text(&self, detail: u8) -> Option<String> {
        let why = self.halted?;
        Some(if detail > 0 { format!("HALTED: {}", printable(why)) } else { "HALTED".to_owned() })
    }

    /// Formats the number of cells in contact. Stale and dead cells appear at full detail, or if their number is not 0.
    fn contact_text(&self, detail: u8) -> Option<String> {
        let (contributing, cells) = (self.contributing, self.cells);
        let width = cells.to_string().len();
        let mut text = match detail {
            0 => return None,
            1 => format!("{contributing:width$} in contact"),
            _ => format!("{contributing:width$} of {cells} in contact"),
        };
        for (count, what) in [(self.stale, "stale"), (self.dead, "dead")] {
            if detail > 2 || count > 0 {
                text += &format!(", {count} {what}");
            }
        }
        Some(text)
    }

    fn torque_text(&self, detail: u8) -> String {
        let each =
            |one: &dyn Fn(&f64) -> String| self.torque_nm.iter().map(one).collect::<Vec<_>>().join(" ");
        match detail {
            0 => {
                let max = self.torque_nm.iter().map(|nm| nm.abs()).fold(0.0, f64::max);
                format!("torque up to {max:.1} Nm")
            }
            1 => format!("torque {} Nm", each(&|nm| format!("{nm:4.1}"))),
            _ => format!("torque {} Nm", each(&|nm| format!("{nm:5.2}"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TORQUE: [f64; 7] = [0.0, -12.345, 1.0, 0.5, -0.25, 0.0, 3.0];

    fn line(joints: usize) -> StatusLine<'static> {
        StatusLine {
            elapsed_s: 3.21,
            duration_s: 12.0,
            lost: &[],
            halted: None,
            contributing: 4,
            cells: 253,
            stale: 0,
            dead: 0,
            late_us: 45.4,
            mode: "compare",
            torque_nm: &TORQUE[..joints],
        }
    }

    #[test]
    fn a_line_without_a_width_has_everything() {
        let all = "  3.2 of 12.0 s    4 of 253 in contact, 0 stale, 0 dead  tick lateness p99 45 µs  compare      \
                   torque  0.00 -12.35  1.00  0.50 -0.25  0.00 Nm";
        assert_eq!(line(6).text(None), all);
        assert_eq!(line(6).text(Some(1_000)), all);
    }

    #[test]
    fn a_narrow_line_leaves_out_what_matters_less() {
        for (width, text) in [
            (
                120,
                "  3.2 of 12.0 s    4 of 253 in contact, 0 stale, 0 dead  torque  0.00 -12.35  1.00  0.50 -0.25  0.00 Nm",
            ),
            (80, "  3.2 of 12.0 s    4 in contact  torque  0.00 -12.35  1.00  0.50 -0.25  0.00 Nm"),
            (60, "  3.2 of 12.0 s  torque  0.0 -12.3  1.0  0.5 -0.2  0.0 Nm"),
            (40, "  3.2 of 12.0 s  torque up to 12.3 Nm"),
            (20, "  3.2 s  torque up to 12.3 Nm"),
        ] {
            assert_eq!(line(6).text(Some(width)), text);
        }
    }

    #[test]
    fn what_is_wrong_stays_in_a_narrow_line() {
        let (lost, halted) = (&["vcan1"][..], Some("a halt frame was received"));
        let wrong = StatusLine { lost, halted, dead: 3, ..line(6) };
        for (width, text) in [
            (
                150,
                "  3.2 of 12.0 s  LOST: vcan1  HALTED: a halt frame was received    4 of 253 in contact, 3 dead  torque  \
                 0.00 -12.35  1.00  0.50 -0.25  0.00 Nm",
            ),
            (80, "  3.2 of 12.0 s  LOST: 1  HALTED  torque  0.0 -12.3  1.0  0.5 -0.2  0.0 Nm"),
            (60, "  3.2 of 12.0 s  LOST: 1  HALTED  torque up to 12.3 Nm"),
            (40, "  3.2 s  LOST: 1  HALTED  torque up to 12.3 Nm"),
        ] {
            assert_eq!(wrong.text(Some(width)), text);
        }
    }

    #[test]
    fn eighty_columns_hold_all_torques_and_every_width_has_some() {
        let lost = ["vcan0", "a-bus-of-15-let"];
        for (joints, lost, halted) in [(6, &lost[..0], None), (7, &lost[..], Some("the torque is not valid"))]
        {
            let line = StatusLine { lost, halted, dead: 3, ..line(joints) };
            for width in 1..300 {
                let text = line.text(Some(width));
                let torques = text.rsplit("torque ").next().unwrap().split_whitespace();
                assert!(text.chars().count() <= width.max(46), "{width}: {text}");
                assert!(width < 80 || torques.count() == joints + 1, "{width}: {text}");
                assert_eq!(
                    (text.contains("LOST"), text.contains("HALTED")),
                    (!lost.is_empty(), halted.is_some())
                );
            }
        }
    }

    #[test]
    fn a_run_without_an_end_has_no_duration() {
        let endless = StatusLine { duration_s: ENDLESS_DURATION_S, ..line(6) };
        assert!(endless.text(None).starts_with("  3.2 s    4 of 253"));
    }
}
