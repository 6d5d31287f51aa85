#include "codec.h"

#include "crc.h"

enum tormag_result tormag_decode(
    struct tormag_message *message, uint8_t function, const uint8_t *payload, size_t length)
{
    const size_t expected = tormag_message_length(function);
    if (expected == 0u) {
        return TORMAG_UNKNOWN_FUNCTION;
    }
    if (length != expected) {
        return TORMAG_WRONG_LENGTH;
    }
    if (tormag_message_protected(function) && tormag_crc8(function, payload, length - 1u) != payload[length - 1u]) {
        return TORMAG_WRONG_CRC;
    }
    message->function = function;
    tormag_message_unpack(message, payload);
    return tormag_message_in_range(message) ? TORMAG_OK : TORMAG_OUT_OF_RANGE;
}

enum tormag_result tormag_encode(uint8_t *payload, size_t *length, const struct tormag_message *message)
{
    const size_t needed = tormag_message_length(message->function);
    if (needed == 0u) {
        return TORMAG_UNKNOWN_FUNCTION;
    }
    if (!tormag_message_in_range(message)) {
        return TORMAG_OUT_OF_RANGE;
    }
    tormag_message_pack(payload, message);
    if (tormag_message_protected(message->function)) {
        payload[needed - 1u] = tormag_crc8(message->function, payload, needed - 1u);
    }
    *length = needed;
    return TORMAG_OK;
}
