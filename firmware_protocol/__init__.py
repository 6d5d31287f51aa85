"""The wire between tormagd and the brake's firmware: messages, codec and serial framing, all following tormag.dbc."""

from firmware_protocol.build import settle

settle()
