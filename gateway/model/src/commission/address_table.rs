//! The assignment of node ids to cells.

use protocol::id::CellId;
use protocol::message::Heartbeat;
use protocol::time::Micros;

use crate::tracker::{AddressClaim, HeartbeatKind, PerCell};

/// The owner of each node id of a bus, from the heartbeats received.
#[derive(Debug, Default)]
pub(super) struct AddressTable(PerCell<AddressClaim>);

impl AddressTable {
    /// Records a heartbeat that was sent under the node id `number`. Returns two serial numbers if two cells use that
    /// node id in turn.
    ///
    /// A single change of the serial number means that one cell replaced another; only a change back proves that both
    /// are present. A claim for a node id with an owner does not change the owner, because the claiming cell yields.
    pub(super) fn receive_heartbeat(
        &mut self,
        now: Micros,
        number: CellId,
        heartbeat: &Heartbeat,
    ) -> Option<[u32; 2]> {
        let claim = self.0.get_mut(number)?;
        let before = *claim;
        let took = matches!(
            claim.receive(now, heartbeat),
            HeartbeatKind::Started { again: true } | HeartbeatKind::Shared
        );
        let [holder, earlier] = [before.serial()?, before.previous()?];
        (took && claim.serial() == Some(earlier) && earlier != holder).then_some([earlier, holder])
    }

    /// Returns the serial number of the owner of a node id.
    pub(super) fn owner_serial(&self, number: CellId) -> Option<u32> {
        self.0.get(number).and_then(AddressClaim::serial)
    }

    /// Returns all node ids in use, with the serial numbers of their owners.
    pub(super) fn owners(&self) -> impl Iterator<Item = (CellId, u32)> {
        self.0.iter().filter_map(|(number, claim)| Some((number, claim.serial()?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::message::State;

    fn heard(said: &[(u32, State)]) -> Vec<Option<[u32; 2]>> {
        let (mut address_table, number) = (AddressTable::default(), CellId::new(5).unwrap());
        let beat = |(at, &(serial, state)): (u16, &(u32, State))| {
            address_table.receive_heartbeat(
                Micros(0),
                number,
                &Heartbeat { serial, state, sent: 40 + at, ..Heartbeat::default() },
            )
        };
        (0..).zip(said).map(beat).collect()
    }

    #[test]
    fn a_change_back_shows_that_two_cells_share_one_node_id() {
        let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
        let both = [(7, settled), (9, settled), (7, settled), (9, settled)];
        assert_eq!(heard(&both), [None, None, Some([7, 9]), None], "told once");
        assert_eq!(heard(&[(7, settled), (9, claims), (7, settled), (9, claims)]), [None; 4]);
        assert_eq!(
            heard(&[(7, settled), (9, settled), (9, settled)]),
            [None; 3],
            "it took the other's place"
        );
    }
}
