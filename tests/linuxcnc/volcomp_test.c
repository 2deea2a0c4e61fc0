// Reads tables with volcomp.h and says of each on a line whether it is good and why not; with -e, evaluates the first one.
//   volcomp_test TABLE...               "1" or "0 message" per table
//   volcomp_test -e TABLE POINTS OUT    POINTS: doubles q0 q1 q2 t0 t1 t2; OUT: e0 e1 e2 and the inverse of q, per point
#include "volcomp.h"

static volcomp_table table;

static int evaluate(char **path)
{
    double point[6], result[6];
    FILE *in = fopen(path[1], "rb"), *out = fopen(path[2], "wb");
    if (!in || !out || !volcomp_load(&table, path[0]))
        return 1;
    while (fread(point, sizeof(double), 6, in) == 6) {
        volcomp_error(&table, point, point + 3, result);
        if (volcomp_inverse(&table, point, point + 3, result + 3))
            return 2;
        fwrite(result, sizeof(double), 6, out);
    }
    return fclose(out);
}

int main(int count, char **word)
{
    int k;
    if (count == 5 && !strcmp(word[1], "-e"))
        return evaluate(word + 2);
    for (k = 1; k < count; k++) {
        volcomp_load(&table, word[k]);
        printf("%d %s\n", table.good, table.good ? "" : table.message);
    }
    return 0;
}
