/* Payload bytes to checked messages and back: lengths, ranges, and the CRC-8 of the protected ones. */
#ifndef TORMAG_CODEC_H
#define TORMAG_CODEC_H

#include "messages.h"

enum tormag_result {
    TORMAG_OK = 0,
    TORMAG_UNKNOWN_FUNCTION,
    TORMAG_WRONG_LENGTH,
    TORMAG_WRONG_CRC,
    TORMAG_OUT_OF_RANGE
};

/* The message in a payload of `length` bytes. Unless TORMAG_OK comes back, `message` holds nothing to be used. */
enum tormag_result tormag_decode(
    struct tormag_message *message, uint8_t function, const uint8_t *payload, size_t length);

/*
 * The payload of a message, and its length; `payload` takes TORMAG_MAX_PAYLOAD bytes. The CRC-8 is computed here,
 * whatever stands in the message's own field. Unless TORMAG_OK comes back, nothing is to be sent.
 */
enum tormag_result tormag_encode(uint8_t *payload, size_t *length, const struct tormag_message *message);

#endif
