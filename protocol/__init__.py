"""What two processes must agree on: messages, framing, codec, images, errors. No sockets."""
