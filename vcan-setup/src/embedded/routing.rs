//! Selects the clients that receive a frame, by the rules of the kernel's `CAN_RAW`.
//!
//! As in the kernel (`net/can/af_can.c`), filters are sorted into classes when they are set, so that a frame is
//! compared only with those that can match. Filters for one exact identifier are found in a table, in a time that does
//! not depend on the number of clients.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use protocol::bus::Filter;
use protocol::bus::embedded::ClientHello;
use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Format, REMOTE, STANDARD_MASK};

/// The number of a client, an index into the server's table of clients.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct ClientId(pub usize);

/// The class of a filter. It determines the list in which the filter is stored.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum FilterClass {
    /// A filter for error frames of the classes in this mask.
    Errors(u32),
    /// A filter that is compared with every frame. With `true`, frames that match it pass; with `false`, frames that do
    /// not match it. Error frames never pass.
    Masked(Filter, bool),
    /// A filter for data frames with exactly this identifier; the flag for 29 bits is included.
    Exact(u32),
}

impl FilterClass {
    /// Returns the class of a filter. Follows the kernel's `can_rcv_list_find`.
    fn from_filter(filter: Filter) -> Self {
        let Filter { id, mut mask } = filter;
        if mask & ERROR != 0 {
            return Self::Errors(mask & EXTENDED_MASK);
        }
        if mask & EXTENDED != 0 && id & EXTENDED == 0 {
            mask &= Filter::EXACT_MASK;
        }
        let matched = Filter { id: id & mask, mask };
        let whole = if id & EXTENDED == 0 { Filter::EXACT_MASK } else { EXTENDED_MASK | EXTENDED | REMOTE };
        match id & (Filter::INVERTED_FLAG | REMOTE) {
            0 if mask == whole => Self::Exact(matched.id),
            flags => Self::Masked(matched, flags & Filter::INVERTED_FLAG == 0),
        }
    }

    /// Returns true if a frame passes the filter. `frame` is the identifier with its flags.
    const fn passes_frame(self, frame: u32) -> bool {
        let error = frame & ERROR != 0;
        match self {
            Self::Errors(mask) => error && frame & mask != 0,
            Self::Masked(Filter { id, mask }, matched) => !error && (frame & mask == id) == matched,
            Self::Exact(id) => frame == id,
        }
    }
}

#[derive(Clone, Debug)]
struct Subscription {
    /// The filters under which the client is stored in the lists.
    filters: Vec<Filter>,
    own_frames: bool,
    fd: bool,
    error_mask: u32,
    /// The number of the frame that was delivered last, so that a frame that matches two filters is delivered once.
    last: u64,
}

impl Subscription {
    fn filter_classes(&self) -> impl Iterator<Item = FilterClass> + use<'_> {
        let errors = (self.error_mask != 0).then_some(FilterClass::Errors(self.error_mask & EXTENDED_MASK));
        self.filters.iter().copied().map(FilterClass::from_filter).chain(errors)
    }
}

/// The filters of all clients.
#[derive(Debug, Default)]
pub struct Router {
    clients: Vec<Option<Subscription>>,
    /// The clients that have a filter for exactly one identifier, by the identifier.
    exact: HashMap<u32, Vec<ClientId>>,
    /// The filters that must be compared with every frame, each with its client.
    masked: Vec<(FilterClass, ClientId)>,
    frames: u64,
}

impl Router {
    /// Creates a router without clients.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a client, or replaces its filters and options.
    pub fn insert(&mut self, client: ClientId, hello: &ClientHello) {
        self.remove(client);
        if self.clients.len() <= client.0 {
            self.clients.resize_with(client.0 + 1, || None);
        }
        let ClientHello { ref filters, own_frames, fd, error_mask, .. } = *hello;
        let wants = Subscription { filters: filters.clone(), own_frames, fd, error_mask, last: 0 };
        self.add_to_lists(client, &wants);
        if let Some(slot) = self.clients.get_mut(client.0) {
            *slot = Some(wants);
        }
    }

    /// Replaces the filters of a client. Its other options stay.
    pub fn set_filters(&mut self, client: ClientId, filters: Vec<Filter>) {
        let Some(mut wants) = self.clients.get_mut(client.0).and_then(Option::take) else { return };
        self.remove_from_lists(client, &wants);
        wants.filters = filters;
        self.add_to_lists(client, &wants);
        if let Some(slot) = self.clients.get_mut(client.0) {
            *slot = Some(wants);
        }
    }

    fn add_to_lists(&mut self, client: ClientId, wants: &Subscription) {
        for class in wants.filter_classes() {
            match class {
                FilterClass::Exact(id) => self.exact.entry(id).or_default().push(client),
                FilterClass::Errors(_) | FilterClass::Masked(..) => self.masked.push((class, client)),
            }
        }
    }

    /// Removes a client, if it is present.
    pub fn remove(&mut self, client: ClientId) {
        if let Some(wants) = self.clients.get_mut(client.0).and_then(Option::take) {
            self.remove_from_lists(client, &wants);
        }
    }

    /// Removes a client from the lists of its filters. Only these lists are searched, because hundreds of clients may
    /// change their filters while frames are waiting.
    fn remove_from_lists(&mut self, client: ClientId, wants: &Subscription) {
        for class in wants.filter_classes() {
            match class {
                FilterClass::Exact(id) => {
                    if let Entry::Occupied(mut list) = self.exact.entry(id) {
                        list.get_mut().retain(|&other| other != client);
                        if list.get().is_empty() {
                            list.remove();
                        }
                    }
                }
                FilterClass::Errors(_) | FilterClass::Masked(..) => {
                    self.masked.retain(|&(_, other)| other != client)
                }
            }
        }
    }

    /// Calls `deliver` for each client that receives a frame. The second argument is true if the client has sent the
    /// frame.
    pub fn route(
        &mut self,
        from: ClientId,
        id: u32,
        format: Format,
        mut deliver: impl FnMut(ClientId, bool),
    ) {
        self.frames += 1;
        let Self { clients, frames, .. } = self;
        let mut offer = |client: ClientId| {
            let Some(wants) = clients.get_mut(client.0).and_then(Option::as_mut) else { return };
            let own = client == from;
            if wants.last != *frames && (wants.own_frames || !own) && (wants.fd || format == Format::Classic)
            {
                wants.last = *frames;
                deliver(client, own);
            }
        };
        let walked = self.masked.iter().filter(|(class, _)| class.passes_frame(id));
        walked.for_each(|&(_, client)| offer(client));
        let standard = id & (EXTENDED | REMOTE | ERROR) == 0;
        let exact = self.exact.get(&if standard { id & STANDARD_MASK } else { id });
        exact.into_iter().flatten().for_each(|&client| offer(client));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::embedded::cases;
    use proptest::prelude::*;

    fn hello(filters: &[Filter]) -> ClientHello {
        ClientHello { filters: filters.to_vec(), ..ClientHello::default() }
    }

    /// Returns the clients that receive a frame, in ascending order, each with true if the frame is its own.
    fn receivers(router: &mut Router, from: usize, id: u32, format: Format) -> Vec<(usize, bool)> {
        let mut receivers = Vec::new();
        router.route(ClientId(from), id, format, |client, own| receivers.push((client.0, own)));
        receivers.sort_unstable();
        receivers
    }

    #[test]
    fn every_case_comes_out_as_can_raw_has_it() {
        for case in cases::cases() {
            let mut router = Router::new();
            let hello = ClientHello {
                filters: case.filters.clone(),
                own_frames: case.own_frames,
                fd: case.fd,
                error_mask: case.error_mask,
                ..ClientHello::default()
            };
            router.insert(ClientId(1), &hello);
            let from = usize::from(case.from_self);
            let got = receivers(&mut router, from, case.frame.raw_id(), case.frame.format()).len();
            assert_eq!(got, usize::from(case.received), "{}", case.what);
        }
    }

    #[test]
    fn a_client_that_left_gets_nothing_and_its_number_can_be_used_again() {
        let mut router = Router::new();
        let exact = Filter { id: 0x123, mask: Filter::EXACT_MASK };
        router.insert(ClientId(1), &hello(&[exact, Filter::ALL, exact.inverted()]));
        router.remove(ClientId(1));
        assert_eq!(receivers(&mut router, 0, 0x123, Format::Classic), []);
        router.insert(ClientId(1), &hello(&[exact]));
        assert_eq!(receivers(&mut router, 0, 0x123, Format::Classic), [(1, false)]);
        assert_eq!(receivers(&mut router, 0, 0x124, Format::Classic), []);
    }

    #[test]
    fn exact_filters_never_reach_a_list_that_every_frame_walks() {
        let mut router = Router::new();
        for client in 0..254 {
            let filters = [0x001, 0x400 + client, 0x8000_0000 + client].map(|id| Filter {
                id,
                mask: if id > STANDARD_MASK { EXTENDED_MASK | EXTENDED | REMOTE } else { Filter::EXACT_MASK },
            });
            router.insert(ClientId(client as usize), &hello(&filters));
        }
        assert!(router.masked.is_empty());
        assert_eq!(receivers(&mut router, 300, 0x001, Format::Fd).len(), 254);
        assert_eq!(receivers(&mut router, 300, 0x407, Format::Fd), [(7, false)]);
        assert_eq!(receivers(&mut router, 300, 0x8000_0007, Format::Fd), [(7, false)]);
    }

    /// Decides by the rule in the kernel's documentation, without the classes that the router uses.
    fn passes(filters: &[Filter], error_mask: u32, id: u32) -> bool {
        let errors = |filter: &&Filter| filter.mask & ERROR != 0;
        if id & ERROR != 0 {
            let masks = filters.iter().filter(errors).map(|filter| filter.mask).chain([error_mask]);
            return masks.into_iter().any(|mask| id & mask & EXTENDED_MASK != 0);
        }
        filters.iter().filter(|filter| !errors(filter)).any(|&Filter { id: target, mut mask }| {
            if mask & EXTENDED != 0 && target & EXTENDED == 0 {
                mask &= STANDARD_MASK | EXTENDED | REMOTE;
            }
            (id & mask == target & mask) != (target & Filter::INVERTED_FLAG != 0)
        })
    }

    fn word() -> impl Strategy<Value = u32> {
        let flags =
            prop::sample::select(vec![0, EXTENDED, REMOTE, EXTENDED | REMOTE, ERROR, EXTENDED | ERROR]);
        (prop_oneof![0_u32..4, 0x7FC..0x800_u32, Just(0x1FFF_FFFF)], flags).prop_map(|(id, flags)| id | flags)
    }

    fn filter() -> impl Strategy<Value = Filter> {
        let exact = Just(Filter::EXACT_MASK);
        let extended = Just(EXTENDED_MASK | EXTENDED | REMOTE);
        let mask = prop_oneof![exact, extended, Just(0), word(), 0x7FC..0x800_u32];
        (word(), mask).prop_map(|(id, mask)| Filter { id, mask })
    }

    /// Returns an identifier in the form that drivers produce: at most 11 bits, unless the flag for 29 bits is set.
    fn sound(id: u32) -> u32 {
        if id & (EXTENDED | ERROR) == 0 { id & (STANDARD_MASK | REMOTE) } else { id }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn filters_that_were_changed_are_as_if_they_had_been_the_first(before in proptest::collection::vec(filter(), 0..5), after in proptest::collection::vec(filter(), 0..5), error_mask in 0..8_u32, id in word()) {
            let id = sound(id);
            let mut router = Router::new();
            router.insert(ClientId(1), &ClientHello { error_mask, own_frames: true, ..hello(&before) });
            router.set_filters(ClientId(1), after.clone());
            let expected = if passes(&after, error_mask, id) { vec![(1, true)] } else { vec![] };
            prop_assert_eq!(receivers(&mut router, 1, id, Format::Classic), expected);
            router.remove(ClientId(1));
            prop_assert_eq!(receivers(&mut router, 0, id, Format::Classic), vec![]);
        }

        #[test]
        fn classes_change_nothing(filters in proptest::collection::vec(filter(), 0..5), error_mask in prop_oneof![Just(0_u32), 0..8_u32], id in word()) {
            let id = sound(id);
            let mut router = Router::new();
            router.insert(ClientId(1), &ClientHello { error_mask, ..hello(&filters) });
            let got = receivers(&mut router, 0, id, Format::Classic);
            let expected = if passes(&filters, error_mask, id) { vec![(1, false)] } else { vec![] };
            prop_assert_eq!(got, expected);
        }
    }
}
