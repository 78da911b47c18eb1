#include "policy.h"
#include <stdio.h>
#define WRITE(x) fwrite(&x, sizeof x, 1, stdout)
int main(void) {
    static policy_state state;
    static policy_readings readings;
    static policy_targets targets;
    float begins, status;
    while (fread(&begins, sizeof begins, 1, stdin) == 1 && fread(&readings, sizeof readings, 1, stdin) == 1) {
        if (begins) policy_reset(&state);
        status = (float)policy_step(&state, &readings, &targets);
        WRITE(status);
        WRITE(state.observation);
        WRITE(state.action);
        WRITE(targets);
    }
    return 0;
}
