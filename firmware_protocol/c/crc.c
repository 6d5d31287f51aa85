#include "crc.h"

#define CRC8_POLYNOMIAL 0x1Du
#define CRC8_INITIAL 0xFFu
#define CRC8_FINAL_XOR 0xFFu
#define CRC16_POLYNOMIAL 0x1021u
#define CRC16_INITIAL 0xFFFFu
#define CRC16_FINAL_XOR 0xFFFFu

static uint8_t crc8_of_byte(uint8_t crc, uint8_t byte)
{
    unsigned int bits = (unsigned int)crc ^ byte;
    for (int bit = 0; bit < 8; bit++) {
        bits = (bits & 0x80u) != 0u ? (bits << 1) ^ CRC8_POLYNOMIAL : bits << 1;
    }
    return (uint8_t)(bits & 0xFFu);
}

uint8_t tormag_crc8(uint8_t function, const uint8_t *payload, size_t length)
{
    uint8_t crc = crc8_of_byte(CRC8_INITIAL, function);
    for (size_t i = 0; i < length; i++) {
        crc = crc8_of_byte(crc, payload[i]);
    }
    return (uint8_t)(crc ^ CRC8_FINAL_XOR);
}

uint16_t tormag_crc16(const uint8_t *data, size_t length)
{
    unsigned int bits = CRC16_INITIAL;
    for (size_t i = 0; i < length; i++) {
        bits ^= (unsigned int)data[i] << 8;
        for (int bit = 0; bit < 8; bit++) {
            bits = (bits & 0x8000u) != 0u ? (bits << 1) ^ CRC16_POLYNOMIAL : bits << 1;
        }
        bits &= 0xFFFFu;
    }
    return (uint16_t)(bits ^ CRC16_FINAL_XOR);
}
