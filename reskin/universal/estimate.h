/* @ABOUT@
 *
 *     #include "skin.h"                       (in one source file of the program)
 *     reskin_result result;
 *     for (i = 0; i < RESKIN_CHANNELS_N; i++)
 *         db_uT[i] = b_uT[i] - reskin_noload_uT[i];
 *     reskin_estimate(db_uT, &result);
 *
 * A reading has the values Bx, By, Bz of chip 0, then of chip 1, and so on, along the axes of the chips. The function
 * needs C99 and the mathematical library, no other library and no dynamic memory. All names begin with `reskin_`. */
#include <math.h>

/* Numbers are computed in this type. With `#define RESKIN_SINGLE` before the header is included, they are computed in
 * single precision, for processors without double precision. */
#ifdef RESKIN_SINGLE
typedef float reskin_real;
#define RESKIN_R(function) function##f
#else
typedef double reskin_real;
#define RESKIN_R(function) function
#endif

typedef struct {
    reskin_real x_mm, y_mm;       /* place; meaningful only in contact */
    reskin_real sd_x_mm, sd_y_mm; /* standard deviations of the place */
    reskin_real force_N;          /* normal force; meaningful only in contact */
    reskin_real sd_log_N;         /* standard deviation of the natural logarithm of the force */
    reskin_real misfit;           /* chi^2 per channel: about 1 for a press on this skin */
    reskin_real change_uT;        /* size of the field change, by which contact is detected */
    int contact;                  /* 1 in contact, 0 without contact, -1 if the threshold is unknown */
} reskin_result;

/* @NUMBERS@ */

/* Results for the hypotheses about one reading. They are static, which keeps them off the stack of small processors.
 * `reskin_estimate` must therefore not run in two threads at once. */
static reskin_real reskin_likely[RESKIN_PLACES_N * RESKIN_FORCES_N];
static reskin_real reskin_of_place[RESKIN_PLACES_N];

static reskin_real reskin_largest(const reskin_real *values, int n)
{
    reskin_real largest = values[0];
    int i;
    for (i = 1; i < n; i++)
        largest = values[i] > largest ? values[i] : largest;
    return largest;
}

/* Write the deviance under each hypothesis to `reskin_likely`. Return the most likely hypothesis, and its chi^2. */
static int reskin_deviances(const float *row, const float *log_det, const float *read_uT, reskin_real *chi2_best)
{
    int h, i, j, best = 0;
    for (h = 0; h < RESKIN_PLACES_N * RESKIN_FORCES_N; h++) {
        reskin_real chi2 = 0;
        for (i = 0; i < RESKIN_CHANNELS_N; i++) {
            reskin_real off = -*row++;
            for (j = 0; j <= i; j++)
                off += *row++ * (reskin_real)read_uT[j];
            chi2 += off * off;
        }
        reskin_likely[h] = chi2 + log_det[h];
        if (h == 0 || reskin_likely[h] < reskin_likely[best]) {
            best = h;
            *chi2_best = chi2;
        }
    }
    return best;
}

#if RESKIN_EXTERNAL
/* Subtract the external field that is expected under one hypothesis. */
static void reskin_remove_external(int hypothesis, const float *read_uT, reskin_real *change_uT)
{
    const float *row = reskin_row + (long)hypothesis * (RESKIN_CHANNELS_N * (RESKIN_CHANNELS_N + 3) / 2);
    reskin_real solved[RESKIN_CHANNELS_N] = {0};
    int i, j;
    for (i = 0; i < RESKIN_CHANNELS_N; i++) {
        reskin_real off = -*row++;
        for (j = 0; j <= i; j++)
            off += row[j] * (reskin_real)read_uT[j];
        for (j = 0; j <= i; j++)
            solved[j] += off * row[j];
        row += i + 1;
    }
    for (i = 0; i < RESKIN_CHANNELS_N; i++)
        for (j = 0; j < RESKIN_CHANNELS_N; j++)
            change_uT[j] -= solved[i] * reskin_external_cov[i * RESKIN_CHANNELS_N + j];
}
#endif

/* Evaluate one network, whose weights begin at `number`: for each output its bias, then its weights. Write the mean and
 * standard deviation of x, y and log F to `estimate`. Return the address after the network's weights. */
static const float *reskin_network(const float *number, const reskin_real *inputs, reskin_real *estimate)
{
    static reskin_real values[RESKIN_WIDTH_MAX], next[RESKIN_WIDTH_MAX];
    int i, o, layer;
    for (i = 0; i < reskin_width[0]; i++)
        values[i] = inputs[i];
    for (layer = 0; layer < RESKIN_LAYERS_N; layer++) {
        for (o = 0; o < reskin_width[layer + 1]; o++) {
            next[o] = *number++;
            for (i = 0; i < reskin_width[layer]; i++)
                next[o] += *number++ * values[i];
        }
        for (o = 0; o < reskin_width[layer + 1]; o++)
            values[o] = layer + 1 < RESKIN_LAYERS_N && next[o] < 0 ? 0 : next[o];
    }
    for (i = 0; i < 3; i++) {
        reskin_real log_sd = values[3 + i];
        log_sd = log_sd < reskin_log_sd_limits[0] ? reskin_log_sd_limits[0] : log_sd;
        log_sd = log_sd > reskin_log_sd_limits[1] ? reskin_log_sd_limits[1] : log_sd;
        estimate[i] = reskin_output_scale[i] * values[i];
        estimate[3 + i] = reskin_output_scale[i] * RESKIN_R(exp)(log_sd);
    }
    return number;
}

/* Combine the networks' estimates to normal distributions of x, y and log F; the spread of the networks adds to the
 * variance. */
static void reskin_networks(const reskin_real *change_uT, reskin_real *mean, reskin_real *sd)
{
    reskin_real inputs[RESKIN_CHANNELS_N + 1], each[RESKIN_NETWORKS_N][6], length_uT = 0;
    const float *number = reskin_weight;
    int i, n;
    for (i = 0; i < RESKIN_CHANNELS_N; i++)
        length_uT += change_uT[i] * change_uT[i];
    length_uT = RESKIN_R(sqrt)(length_uT);
    length_uT = length_uT < reskin_length_min_uT ? reskin_length_min_uT : length_uT;
    for (i = 0; i < RESKIN_CHANNELS_N; i++)
        inputs[i] = (float)(reskin_direction_gain * change_uT[i] / length_uT);
    inputs[RESKIN_CHANNELS_N] = (float)(RESKIN_R(log)(length_uT) - reskin_log_uT);
    for (n = 0; n < RESKIN_NETWORKS_N; n++)
        number = reskin_network(number, inputs, each[n]);
    for (i = 0; i < 3; i++) {
        reskin_real var = 0;
        mean[i] = 0;
        for (n = 0; n < RESKIN_NETWORKS_N; n++)
            mean[i] += each[n][i] / RESKIN_NETWORKS_N;
        for (n = 0; n < RESKIN_NETWORKS_N; n++)
            var += (each[n][3 + i] * each[n][3 + i] + (each[n][i] - mean[i]) * (each[n][i] - mean[i]))
                   / RESKIN_NETWORKS_N;
        sd[i] = RESKIN_R(sqrt)(var);
        sd[i] = sd[i] < reskin_sd_min[i] ? reskin_sd_min[i] : sd[i];
    }
}

/* Return half of the squared distance of a value from the mean, in standard deviations. */
static reskin_real reskin_half_square(reskin_real value, reskin_real mean, reskin_real sd)
{
    return (reskin_real)0.5 * ((value - mean) / sd) * ((value - mean) / sd);
}

/* Return the logarithm of a probability; a probability below `reskin_tiny` is replaced by it. */
static reskin_real reskin_log(reskin_real probability)
{
    return RESKIN_R(log)(probability < reskin_tiny ? reskin_tiny : probability);
}

/* Return exp(x) for x <= 0; a value of x below -`reskin_farthest` is replaced by it. */
static reskin_real reskin_exp(reskin_real x)
{
    return RESKIN_R(exp)(x < -reskin_farthest ? -reskin_farthest : x);
}

/* Multiply the map's marginal probabilities of places and forces by the networks' normal distributions. `reskin_likely`
 * has the deviances, and `least` is the least of them. Write the place and its standard deviations to `result`; the
 * standard deviations are those of a power of the product. Return the log force. */
static reskin_real reskin_products(reskin_real least, const reskin_real *mean, const reskin_real *sd,
                                   reskin_real power, reskin_result *result)
{
    reskin_real of_force[RESKIN_FORCES_N] = {0}, sum = 0, most, x = 0, y = 0, xx = 0, yy = 0, log_N = 0;
    int p, q;
    for (p = 0; p < RESKIN_PLACES_N; p++) {
        reskin_of_place[p] = 0;
        for (q = 0; q < RESKIN_FORCES_N; q++) {
            reskin_real weight = reskin_exp(reskin_half_map_power * (least - reskin_likely[p * RESKIN_FORCES_N + q]));
            reskin_of_place[p] += weight;
            of_force[q] += weight;
        }
        sum += reskin_of_place[p];
    }
    for (p = 0; p < RESKIN_PLACES_N; p++)
        reskin_of_place[p] = reskin_log(reskin_of_place[p] / sum)
                             - reskin_half_square(reskin_place_mm[2 * p], mean[0], sd[0])
                             - reskin_half_square(reskin_place_mm[2 * p + 1], mean[1], sd[1]);
    most = reskin_largest(reskin_of_place, RESKIN_PLACES_N);
    for (p = 0, sum = 0; p < RESKIN_PLACES_N; p++) {
        reskin_real weight = reskin_exp(reskin_of_place[p] - most);
        sum += weight;
        x += weight * reskin_place_mm[2 * p];
        y += weight * reskin_place_mm[2 * p + 1];
    }
    x /= sum;
    y /= sum;
    for (p = 0, sum = 0; p < RESKIN_PLACES_N; p++) {
        reskin_real weight = reskin_exp(power * (reskin_of_place[p] - most));
        sum += weight;
        xx += weight * (reskin_place_mm[2 * p] - x) * (reskin_place_mm[2 * p] - x);
        yy += weight * (reskin_place_mm[2 * p + 1] - y) * (reskin_place_mm[2 * p + 1] - y);
    }
    xx /= sum;
    yy /= sum;
    result->x_mm = x;
    result->y_mm = y;
    result->sd_x_mm = RESKIN_R(sqrt)(xx < reskin_var_min_mm2 ? reskin_var_min_mm2 : xx);
    result->sd_y_mm = RESKIN_R(sqrt)(yy < reskin_var_min_mm2 ? reskin_var_min_mm2 : yy);
    for (q = 0, sum = 0; q < RESKIN_FORCES_N; q++)
        sum += of_force[q];
    for (q = 0; q < RESKIN_FORCES_N; q++) {
        of_force[q] = reskin_log(of_force[q] / sum);
        if (RESKIN_FORCE_BY_MAP)
            of_force[q] *= reskin_force_power;
        else
            of_force[q] -= reskin_half_square(reskin_log_N[q], mean[2], sd[2]);
    }
    most = reskin_largest(of_force, RESKIN_FORCES_N);
    for (q = 0, sum = 0; q < RESKIN_FORCES_N; q++) {
        reskin_real weight = RESKIN_R(exp)(of_force[q] - most);
        sum += weight;
        log_N += weight * reskin_log_N[q];
    }
    return log_N / sum;
}

/* Estimate the contact from field changes since the no-load reading, along the chips' axes. */
static void reskin_estimate(const reskin_real *db_uT, reskin_result *result)
{
    reskin_real change_uT[RESKIN_CHANNELS_N], mean[3], sd[3], log_N, off, size2 = 0, chi2 = 0;
    float read_uT[RESKIN_CHANNELS_N];
    int i, j, best;
    for (j = 0; j < RESKIN_CHANNELS_N; j++) {
        reskin_real shrunk_uT = RESKIN_SUPPRESSED ? 0 : db_uT[j];
        for (i = 0, change_uT[j] = 0; i < RESKIN_CHANNELS_N; i++) {
            change_uT[j] += db_uT[i] * reskin_turn[i * RESKIN_CHANNELS_N + j];
#if RESKIN_SUPPRESSED
            shrunk_uT += db_uT[i] * reskin_suppressor[i * RESKIN_CHANNELS_N + j];
#endif
        }
        read_uT[j] = (float)change_uT[j];
        size2 += shrunk_uT * shrunk_uT;
    }
    best = reskin_deviances(reskin_row, reskin_log_det, read_uT, &chi2);
#if RESKIN_EXTERNAL
    reskin_remove_external(best, read_uT, change_uT);
#endif
    reskin_networks(change_uT, mean, sd);
    log_N = reskin_products(reskin_likely[best], mean, sd, reskin_power, result);
    result->misfit = chi2 / RESKIN_CHANNELS_N;
#if RESKIN_FEW_N
    /* A few forces are known: close to these presses, the map that uses them estimates the force (`near`). Elsewhere,
     * the force is that of the map without them. */
    {
        reskin_real log_N_near = log_N, least = 0;
        reskin_result unused;
        best = reskin_deviances(reskin_row_unlabelled, reskin_log_det_unlabelled, read_uT, &chi2);
        log_N = reskin_products(reskin_likely[best], mean, sd, 1, &unused);
        off = log_N - reskin_log_centre_N;
        log_N = reskin_log_centre_N + reskin_line[0] + reskin_line[1] * off;
        for (i = 0; i < RESKIN_FEW_N; i++) {
            const reskin_real *press = reskin_few + 3 * i;
            reskin_real distance = reskin_half_square(press[0], result->x_mm, reskin_length_mm)
                                   + reskin_half_square(press[1], result->y_mm, reskin_length_mm)
                                   + reskin_half_square(press[2], log_N, reskin_length_log_N);
            least = i == 0 || distance < least ? distance : least;
        }
        least = RESKIN_R(exp)(-least);
        log_N = least * log_N_near + (1 - least) * log_N;
    }
#else
    off = log_N - reskin_log_centre_N;
    log_N = reskin_log_centre_N + reskin_line[0] + reskin_line[1] * off;
#endif
    result->x_mm += reskin_centre_mm[0];
    result->y_mm += reskin_centre_mm[1];
    result->force_N = RESKIN_R(exp)(log_N);
    result->sd_log_N = RESKIN_R(sqrt)(reskin_line[2] + off * (2 * reskin_line[3] + off * reskin_line[4]));
    result->change_uT = RESKIN_R(sqrt)(size2);
    result->contact = reskin_contact_uT < 0 ? -1 : result->change_uT > reskin_contact_uT;
}
