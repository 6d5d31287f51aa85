"""The CRC-8 of the protected messages."""

from typing import Final

CRC8_POLYNOMIAL: Final = 0x1D  # SAE J1850: Hamming distance 3 over 64 bits
CRC8_INITIAL: Final = 0xFF
CRC8_FINAL_XOR: Final = 0xFF


def _crc8_table() -> bytes:
    table = []
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = register << 1 ^ (CRC8_POLYNOMIAL if register & 0x80 else 0)
            register &= 0xFF
        table.append(register)
    return bytes(table)


CRC8_TABLE: Final = _crc8_table()
"The next register, by register XOR byte."
CRC8_RESIDUE: Final = CRC8_TABLE[0xFF] ^ CRC8_FINAL_XOR
"`crc8` of data and their CRC."


def crc8(data: bytes, register: int = CRC8_INITIAL) -> int:
    for place in range(len(data)):  # compiled, fastest
        register = CRC8_TABLE[register ^ data[place]]
    return register ^ CRC8_FINAL_XOR
