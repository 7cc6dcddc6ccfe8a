//! The messages that wait for one viewer. The queue is bounded: under load the oldest messages are dropped and counted.

use std::collections::{BTreeMap, VecDeque};

use super::protocol::{StatusLevel, Subscription, message_data, status};

/// The maximum number of messages that wait for a viewer: more than a second of a recording at usual rates.
const MAX_WAITING_MESSAGES: usize = 8_192;
/// The maximum size of the messages that wait for a viewer, in bytes. A longer message waits alone.
const MAX_WAITING_BYTES: usize = 4 << 20;
/// The maximum number of texts that wait for a viewer. Further ones are dropped, since they are answers to its messages.
const MAX_WAITING_TEXTS: usize = 64;

/// A message to a viewer.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(super) enum QueuedMessage {
    /// A text message.
    Text(String),
    /// A binary message.
    Binary(Vec<u8>),
}

/// The subscriptions of a viewer, and the messages that wait for it.
#[derive(Debug, Default)]
pub(super) struct ViewerQueue {
    /// The viewer's subscription of each channel.
    subscriptions: BTreeMap<u32, u32>,
    texts: VecDeque<String>,
    waiting: VecDeque<Vec<u8>>,
    waiting_bytes: usize,
    /// The time that the viewer is told next.
    time: Option<Vec<u8>>,
    dropped: u64,
    reported: u64,
}

impl ViewerQueue {
    /// Adds a text; drops it if too many wait.
    pub(super) fn push_text(&mut self, text: String) {
        if self.texts.len() < MAX_WAITING_TEXTS {
            self.texts.push_back(text);
        }
    }

    /// Sets the time that the viewer is told after the messages that wait now.
    pub(super) fn set_time(&mut self, time: Vec<u8>) {
        self.time = Some(time);
    }

    /// Returns true if the viewer has subscribed to a channel.
    pub(super) fn is_subscribed(&self, channel: u32) -> bool {
        self.subscriptions.contains_key(&channel)
    }

    /// Returns true if the viewer has subscribed to any channel.
    pub(super) fn has_subscriptions(&self) -> bool {
        !self.subscriptions.is_empty()
    }

    /// Adds a message of a channel, if the viewer has subscribed to the channel.
    pub(super) fn push(&mut self, channel: u32, nanos: u64, message: &[u8]) {
        let Some(subscription) = self.subscriptions.get(&channel) else { return };
        let data = message_data(*subscription, nanos, message);
        while self.waiting.len() >= MAX_WAITING_MESSAGES
            || (self.waiting_bytes + data.len() > MAX_WAITING_BYTES && !self.waiting.is_empty())
        {
            let oldest = self.waiting.pop_front();
            self.waiting_bytes -= oldest.map_or(0, |oldest| oldest.len());
            self.dropped += 1;
        }
        self.waiting_bytes += data.len();
        self.waiting.push_back(data);
    }

    /// Begins a subscription. Returns false if it is refused; a text for the viewer says why.
    pub(super) fn subscribe(
        &mut self,
        Subscription { id, channel_id }: Subscription,
        is_known: bool,
    ) -> bool {
        let refused = if !is_known {
            Some(format!("subscription {id}: channel {channel_id} is not advertised"))
        } else if self.subscriptions.contains_key(&channel_id) {
            Some(format!("subscription {id}: channel {channel_id} has a subscription: end that first"))
        } else if self.subscriptions.values().any(|known| *known == id) {
            Some(format!("subscription {id} is in use: choose another number"))
        } else {
            self.subscriptions.insert(channel_id, id);
            None
        };
        let is_accepted = refused.is_none();
        refused.into_iter().for_each(|why| self.push_text(status(StatusLevel::Error, &why)));
        is_accepted
    }

    /// Ends a subscription. Messages that wait for it are dropped uncounted.
    pub(super) fn unsubscribe(&mut self, id: u32) {
        let before = self.subscriptions.len();
        self.subscriptions.retain(|_, known| *known != id);
        if self.subscriptions.len() == before {
            let why = format!("subscription {id} does not exist");
            return self.push_text(status(StatusLevel::Warning, &why));
        }
        let marked = id.to_le_bytes();
        self.waiting.retain(|data| data.get(1..5) != Some(&marked[..]));
        self.waiting_bytes = self.waiting.iter().map(Vec::len).sum();
    }

    /// Removes all messages that wait, uncounted: the recording is played from another position.
    pub(super) fn clear_messages(&mut self) {
        self.waiting.clear();
        self.waiting_bytes = 0;
    }

    /// Tells the viewer how many messages were dropped, if that has changed since the last call.
    pub(super) fn report_dropped(&mut self) {
        if self.dropped > self.reported {
            self.reported = self.dropped;
            let dropped = self.dropped;
            let why = format!(
                "{dropped} messages were dropped so far, the oldest first, because this viewer reads them too \
                 slowly: show fewer topics"
            );
            self.push_text(status(StatusLevel::Warning, &why));
        }
    }

    /// Returns the next message: texts first, then data in their order, then the time.
    pub(super) fn pop(&mut self) -> Option<QueuedMessage> {
        if let Some(text) = self.texts.pop_front() {
            return Some(QueuedMessage::Text(text));
        }
        if let Some(data) = self.waiting.pop_front() {
            self.waiting_bytes -= data.len();
            return Some(QueuedMessage::Binary(data));
        }
        self.time.take().map(QueuedMessage::Binary)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn subscribed(pairs: &[(u32, u32)]) -> ViewerQueue {
        let mut queue = ViewerQueue::default();
        for &(id, channel_id) in pairs {
            assert!(queue.subscribe(Subscription { id, channel_id }, true));
        }
        queue
    }

    fn texts(queue: &mut ViewerQueue) -> Vec<String> {
        queue.texts.drain(..).collect()
    }

    #[test]
    fn the_newest_messages_stay_and_the_dropped_ones_are_told() {
        let mut queue = subscribed(&[(7, 1)]);
        let all = MAX_WAITING_MESSAGES as u64 + 100;
        (0..all).for_each(|at| queue.push(1, at, &[0; 4]));
        queue.push(2, 0, &[0; 4]);
        queue.report_dropped();
        queue.report_dropped();
        let [said] = texts(&mut queue).try_into().unwrap();
        assert!(
            said.starts_with(r#"{"op":"status","level":1,"message":"100 messages were dropped"#),
            "{said}"
        );
        for at in 100..all {
            assert_eq!(queue.pop(), Some(QueuedMessage::Binary(message_data(7, at, &[0; 4]))));
        }
        assert_eq!((queue.pop(), queue.waiting_bytes), (None, 0));
    }

    #[test]
    fn long_messages_are_bounded_by_their_bytes() {
        let mut queue = subscribed(&[(7, 1)]);
        (0..10).for_each(|at| queue.push(1, at, &vec![0; MAX_WAITING_BYTES / 4]));
        assert_eq!((queue.waiting.len(), queue.dropped), (3, 7));
        queue.push(1, 10, &vec![0; 2 * MAX_WAITING_BYTES]);
        assert_eq!((queue.waiting.len(), queue.dropped), (1, 10));
    }

    #[test]
    fn wrong_subscriptions_are_refused_with_a_text() {
        let mut queue = subscribed(&[(1, 10)]);
        for (id, channel_id, is_known, expected) in [
            (2, 11, false, "subscription 2: channel 11 is not advertised"),
            (2, 10, true, "subscription 2: channel 10 has a subscription: end that first"),
            (1, 12, true, "subscription 1 is in use: choose another number"),
        ] {
            assert!(!queue.subscribe(Subscription { id, channel_id }, is_known));
            assert_eq!(texts(&mut queue), [status(StatusLevel::Error, expected)]);
        }
        queue.push(10, 1, &[]);
        queue.unsubscribe(1);
        assert!(!queue.is_subscribed(10) && queue.pop().is_none());
        queue.unsubscribe(1);
        assert_eq!(texts(&mut queue), [status(StatusLevel::Warning, "subscription 1 does not exist")]);
        assert!(queue.subscribe(Subscription { id: 1, channel_id: 12 }, true));
    }

    #[test]
    fn texts_are_bounded_and_the_time_comes_last_and_once() {
        let mut queue = subscribed(&[(1, 10)]);
        (0..1_000).for_each(|number| queue.unsubscribe(100 + number));
        queue.push(10, 5, &[]);
        queue.set_time(vec![2]);
        queue.set_time(vec![3]);
        assert_eq!(texts(&mut queue).len(), MAX_WAITING_TEXTS);
        assert_eq!(queue.pop(), Some(QueuedMessage::Binary(message_data(1, 5, &[]))));
        assert_eq!((queue.pop(), queue.pop()), (Some(QueuedMessage::Binary(vec![3])), None));
    }
}
