/* Of each event with a condition a number, positive or zero where it is true. */
void PREFIX_guards(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* The priority of each event: those at given times, then those with a condition. */
void PREFIX_ranks(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* Of each event at given times the first one (NaN: the start), the interval (0: once) and the last time. */
void PREFIX_timing(const PREFIX_parameters *p, double *values);

/* The states after an event. */
void PREFIX_happen(const PREFIX_parameters *p, double t, const double *x, const double *u, int event, double *found);

/* What a trajectory remembers of its events: its start, how often those at given times happened, how far the zeros of
   indicators lie from those of conditions, which conditions are true, and which events are to happen now. */
typedef struct {
    double start, turn[PREFIX_TIMED + 1], band[PREFIX_GUARDS + 1];
    int on[PREFIX_GUARDS + 1], pending[PREFIX_TIMED + PREFIX_GUARDS];
} PREFIX_events;

/* Begins a trajectory: conditions that are true at its start make nothing happen, unless the event is armed. */
void PREFIX_arm(const PREFIX_parameters *p, double t, const double *x, const double *u, PREFIX_events *e);

/* The next time of an event at given times; infinite after the last one. */
double PREFIX_due(const PREFIX_parameters *p, const PREFIX_events *e, int event);

/* Carries out what happens now, in its order, and what that causes. Returns how many events, -1 if they do not end. */
int PREFIX_carry_out(const PREFIX_parameters *p, double t, const double *u, double *x, PREFIX_events *e);

/* One step of length h from t, cut where conditions become true; inputs are `value + slope * (time - begin)`. An event at
   the end of the step is left to be carried out there. Returns 0, or 1 if events follow each other without end. */
int PREFIX_cut(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
               double *x, PREFIX_events *e);

