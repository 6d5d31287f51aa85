/* libFuzzer's entry. TORMAG_FUZZ names the function that hears the bytes: codec, framing or device. */
#include "fuzz.h"

#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static const struct {
    const char *name;
    void (*hears)(const uint8_t *data, size_t size);
} TARGETS[] = {
    {"codec", tormag_fuzz_codec},
    {"framing", tormag_fuzz_framing},
    {"device", tormag_fuzz_device},
};

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const char *name = getenv("TORMAG_FUZZ");
    for (size_t i = 0; i < sizeof TARGETS / sizeof TARGETS[0]; i++) {
        if (name != NULL && strcmp(name, TARGETS[i].name) == 0) {
            TARGETS[i].hears(data, size);
            return 0;
        }
    }
    fputs("TORMAG_FUZZ: allowed are codec, framing and device\n", stderr);
    exit(2);
}
