//! Frames that the kernel drops between a sender and the sockets although the sender's call succeeds: the queue of
//! arrived packets of a processor was full (`net.core.netdev_max_backlog`).
//!
//! The kernel counts them for the whole machine, over all networks and interfaces.

use std::fs;

/// Number of packets that the machine has dropped so far, or `None` if the kernel does not report it.
pub(crate) fn dropped_packets() -> Option<u64> {
    parse_softnet_stat(&fs::read_to_string("/proc/net/softnet_stat").ok()?)
}

/// Returns the sum of the second column over all processors. The column is a hexadecimal count modulo 2
/// 32.
fn parse_softnet_stat(text: &str) -> Option<u64> {
    text.lines().map(|line| u64::from_str_radix(line.split_whitespace().nth(1)?, 16).ok()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drops_are_summed_over_the_processors() {
        let text = "\
0000fc3b 0000000a 00000012 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000
00012a07 00000010 0000000b 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000001
";
        assert_eq!(parse_softnet_stat(text), Some(26));
        assert_eq!(parse_softnet_stat("0000fc3b\n"), None);
        assert_eq!(parse_softnet_stat("0000fc3b x\n"), None);
    }
}
