"""What a network does to messages: delay, loss, reordering, partition; injected into any transport."""
