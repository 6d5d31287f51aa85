#include "fuzz.h"

#include <string.h>

#include "../codec.h"
#include "../crc.h"

/* As the protocol's page says it, not as the sources do. */
static bool has_crc(uint8_t function)
{
    return function == TORMAG_FUNCTION_DRIVE || function == TORMAG_FUNCTION_STATE;
}

/* What a payload is refused with before its ranges are looked at. */
static enum tormag_result form(uint8_t function, const uint8_t *payload, size_t length)
{
    if (tormag_message_length(function) == 0u) {
        return TORMAG_UNKNOWN_FUNCTION;
    }
    if (length != tormag_message_length(function)) {
        return TORMAG_WRONG_LENGTH;
    }
    if (has_crc(function) && tormag_crc8(function, payload, length - 1u) != payload[length - 1u]) {
        return TORMAG_WRONG_CRC;
    }
    return TORMAG_OK;
}

static void hear(uint8_t function, const uint8_t *payload, size_t length)
{
    struct tormag_message message;
    uint8_t again[TORMAG_MAX_PAYLOAD];
    size_t again_length = 0u;
    const enum tormag_result wanted = form(function, payload, length);
    const enum tormag_result result = tormag_decode(&message, function, payload, length);
    REQUIRE(wanted == TORMAG_OK ? result == TORMAG_OK || result == TORMAG_OUT_OF_RANGE : result == wanted);
    if (result == TORMAG_OK) {
        REQUIRE(tormag_encode(again, &again_length, &message) == TORMAG_OK);
        REQUIRE(again_length == length && memcmp(again, payload, length) == 0);
    }
}

/* Steps that no payload brought: what is sent is a message. */
static void say(uint8_t function, const uint8_t *steps, size_t length)
{
    struct tormag_message message;
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    size_t sent = 0u;
    memset(&message, 0, sizeof message);
    message.function = function;
    if (length > 0u) {
        memcpy(&message.signals, steps, length < sizeof message.signals ? length : sizeof message.signals);
    }
    if (tormag_encode(payload, &sent, &message) == TORMAG_OK) {
        REQUIRE(form(function, payload, sent) == TORMAG_OK);
        REQUIRE(tormag_decode(&message, function, payload, sent) == TORMAG_OK);
    }
}

void tormag_fuzz_codec(const uint8_t *data, size_t size)
{
    if (size == 0u) {
        return;
    }
    const uint8_t function = data[0];
    const uint8_t *payload = data + 1;
    const size_t length = size - 1u;
    hear(function, payload, length);
    say(function, payload, length);
    if (form(function, payload, length) == TORMAG_WRONG_CRC) { /* chance is too seldom right */
        uint8_t sealed[TORMAG_MAX_PAYLOAD];
        memcpy(sealed, payload, length);
        sealed[length - 1u] = tormag_crc8(function, payload, length - 1u);
        hear(function, sealed, length);
    }
}
