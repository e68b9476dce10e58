"""A SEPTIC application of our own making: two CVs, two MVs, a measured disturbance, a deadband, and what has no equal."""

import numpy as np

CNFG = """\
// an example of our own
  System:        Plant
         Text1=  "A small plant"
         Nsecs=  10
          Grps=  2
                 "One"  "Two"
       RootPwd=  "secret"

  SopcProc:      Plant
      ServName=  "https://server//a"

  DmmyAppl:      Helpers

  Evr:           BandSize
          Meas=  1.5

  CalcModl:      Calculations

  CalcPvr:       InBand
           Alg=  "timeron(abs(Level - LevelSteady) < BandSize, 10)"

  CalcPvr:       Band
           Alg=  "setfulfdynscale(Level, if(InBand, 0, 1))"

  MPCAppl:       Control
         Text1=  "Level and flow"
         Nhorz=  40
         Npred=  50
       DesMode=  ACTIVE

  Mvr:           Valve
         Text1=  "Outlet valve"
          Mode=  ACTIVE
          Nfix=  1
          Unit=  "%"
          Meas=  50
          Span=  20
        HighOn=  90
         LowOn=  10
  ProcessValue=  50
         IvOff=  100
         MaxUp=  2
         MaxDn=  -4
     MovePnlty=  8
      Blocking=  4    2     4
                      8    26   // samples
        PVPred=  ON

  Mvr:           Pump
          Unit=  "Hz"
          Meas=  45
          Span=  10
       HighOff=  60
         LowOn=  -1e+010
         MaxUp=  1
         MaxDn=  -1
     MovePnlty=  2
      Blocking=  3    5    10    30

  Cvr:           Level
         Text1=  "Level in drum"
          Unit=  "cm"
          Meas=  120
          Span=  10
      SetPntOn=  125
        HighOn=  150
        LowOff=  0
          Fulf=  4
     HighPnlty=  2
      LowPnlty=  1
     BiasTfilt=  20
     BadCntLim=  3
        EvalDT=  2
MeasValidation=  ON
 MeasHighLimit=  200
  MeasLowLimit=  -1e10
      Surprise=  7

  Cvr:           Flow
          Unit=  "m3/h"
          Meas=  30
          Span=  5
     SetPntOff=  31
        EvalDT=  2

  Dvr:           Feed
          Unit=  "t/h"
          Span=  2

  ExprModl:      Models

  DisplayGroup:  Pictures
       GroupNo=  1

  Gadget:        New
          Size=  3
"""
PAIRS = {
    ("Level", "Valve"): (-0.5, 80.0),
    ("Level", "Pump"): (1.25, 120.0),
    ("Flow", "Valve"): (0.3, 40.0),
    ("Level", "Feed"): (2.0, 150.0),
}
TIMES = 10.0 * np.arange(61)


def response(cv: str, of: str) -> np.ndarray:
    """S(0), S(1), ... of a pair, as the files print them."""
    gain, constant = PAIRS[cv, of]
    return np.round(gain * (1 - np.exp(-TIMES / constant)), 6)


def mdf(values, nsecs: float = 10.0, **more: str) -> str:
    """The text of a model file."""
    listed = [f"{value:.6f}" for value in values]
    lines = [
        "// File= example.mdf",
        'Text1= "first"',
        'Text2= ""',
        'Atext= "a"',
        'Btext= ""',
        f"Nsecs= {nsecs:g}",
    ]
    lines += [f"{key}= {value}" for key, value in more.items()]
    lines += [
        f"Amodl= {len(listed)}",
        *(" ".join(listed[k : k + 7]) for k in range(0, len(listed), 7)),
        "Bmodl= 0",
    ]
    return "\n".join(lines) + "\n"


def write(folder, text: str = CNFG):
    """The whole application; returns the folder."""
    folder.mkdir(exist_ok=True)
    (folder / "control.cnfg").write_text(text)
    for cv, of in PAIRS:
        (folder / f"{cv}_{of}.mdf").write_text(mdf(response(cv, of)))
    return folder
